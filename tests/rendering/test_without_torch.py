"""Rendering works without torch; functions that need it name the extra. Torch cannot be imported in the subprocess."""

import subprocess
import sys

CODE = """
import sys
sys.modules["torch"] = None
import kissgs, pytest
from kissgs.core.errors import UnsupportedError
scene = kissgs.sample_scene(300, sh_degree=1)
views = kissgs.virtual_views(scene, width=32, height=24, count=2)
result = kissgs.evaluate(scene, kissgs.decompress(kissgs.compress(scene).files), views)
assert result.mean.candidate_vs_reference.psnr > 15
with pytest.raises(UnsupportedError, match="train"):
    import kissgs.rendering.differentiable
with pytest.raises(UnsupportedError, match="cuda"):
    kissgs.render(scene, views.train[0].camera, device="cuda")
"""


def test_rendering_does_not_need_torch():
    done = subprocess.run([sys.executable, "-c", CODE], check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
