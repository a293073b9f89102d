"""Rendering works without torch; functions that need it name the extra. Torch cannot be imported in the subprocess."""

import subprocess
import sys
from pathlib import Path

CODE = """
import sys
sys.modules["torch"] = None
sys.path.insert(0, sys.argv[1])
import kissgs, pytest
from helpers.fewer_cameras import try_fewer
from kissgs.core.errors import UnsupportedError
try_fewer(pytest.MonkeyPatch(), azimuths=4, radii=(1.1,))
settings = kissgs.Settings.research("balanced", sensitivity_views=4, sensitivity_view_size=48)
scene = kissgs.sample_scene(300, sh_degree=1)
views = kissgs.virtual_views(scene, width=32, height=24, count=2)
result = kissgs.evaluate(scene, kissgs.decompress(kissgs.compress(scene, settings=settings).files), views)
assert result.mean.candidate_vs_reference.psnr > 15
with pytest.raises(UnsupportedError, match="train"):
    import kissgs.rendering.differentiable
with pytest.raises(UnsupportedError, match="cuda"):
    kissgs.render(scene, views.train[0].camera, device="cuda")
"""


def test_rendering_does_not_need_torch():
    command = [sys.executable, "-c", CODE, str(Path(__file__).parents[1])]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
