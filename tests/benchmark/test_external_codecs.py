"""Reference: a fake splat-transform with known errors, and the real one if it is installed."""

import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.web_tools import node

from kissgs.benchmark.external_codecs import measure_external
from kissgs.cameras.views import View, Views
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.evaluation.evaluate import evaluate
from kissgs.io.ply import read_ply, write_ply
from kissgs.rendering.camera import look_at
from kissgs.synthetic.scene import sample_scene

SPLAT_TRANSFORM = Path(__file__).parents[2] / "web_decoder/node_modules/.bin/splat-transform"

FAKE_TOOL = """
import sys
from pathlib import Path

import numpy as np

*options, source, target = sys.argv[1:]
with Path(__file__).with_suffix(".log").open("a") as log:
    print(*options, Path(target).name, file=log)
data = Path(source).read_bytes()
if target.endswith(".ply"):  # reverse the rows, move all along x, change the colour of invisible ones
    header, _, body = data.partition(b"end_header\\n")
    names = [line.split()[2].decode() for line in header.splitlines() if line.startswith(b"property")]
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names))[::-1].copy()
    rows[:, names.index("x")] += 0.001
    rows[rows[:, names.index("opacity")] < -5.55, names.index("f_dc_0")] = 9
    data = header + b"end_header\\n" + rows.tobytes()
Path(target).write_bytes(data)
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.ply"
    with path.open("wb") as file:
        write_ply(file, sample_scene(1000, sh_degree=1))
    return path


def tool(folder: Path, code: str) -> tuple[str, str]:
    script = folder / "tool.py"
    script.write_text(code)
    return sys.executable, str(script)


def test_bytes_seconds_and_errors(scene, tmp_path):
    result = measure_external(scene, "spz", command=tool(tmp_path, FAKE_TOOL))
    assert (result.format, result.gaussians, result.kept) == ("spz", 1000, 1000)
    assert result.bytes == scene.stat().st_size
    assert result.bytes_per_gaussian == result.bytes / 1000
    assert 0 < result.encode_cpu_seconds < 30
    assert 0 < result.decode_cpu_seconds < 30
    assert 950 < result.errors.gaussians < 1000, "invisible Gaussians are not compared"
    assert result.errors.means.rmse == pytest.approx(0.001 / np.sqrt(3), rel=1e-3)
    assert result.errors.sh0.max == 0
    assert result.errors.shN.energy_kept == 1
    assert result.as_dict()["bytes_per_gaussian"] == result.bytes_per_gaussian
    assert result.as_dict()["errors"]["means"]["max"] == result.errors.means.max


def test_the_memory_is_that_of_the_tool_alone(scene, tmp_path):
    """The tool holds 128 MB; this process holds 1 GB, which Linux would count as that of the process it starts."""
    held = b"x" * 2**30
    code = FAKE_TOOL + "\nheld = b'x' * 2**27\n"
    result = measure_external(scene, "spz", command=tool(tmp_path, code), errors=False)
    assert 2**27 < result.peak_memory < len(held)
    assert result.errors is None


def test_images_are_compared_on_request(scene, tmp_path):
    view = View(
        "front", look_at(np.array([1.2, -2.2, -5.2]), np.zeros(3), np.array([0, -1.0, 0]), fov=1, width=48, height=32)
    )
    views = Views((), (view,), np.zeros(3, np.float32), "one camera")
    result = measure_external(scene, "spz", command=tool(tmp_path, FAKE_TOOL), evaluate=True, views=views)
    moved = read_ply(scene)
    moved.means[:, 0] += np.float32(0.001)
    expected = evaluate(read_ply(scene), moved, views)
    assert result.evaluation.mean.candidate_vs_reference.psnr == pytest.approx(
        expected.mean.candidate_vs_reference.psnr, abs=0.05
    )
    assert result.as_dict()["evaluation"]["views"][0]["name"] == "front"


def test_the_command_line_of_the_tool(scene, tmp_path):
    command = tool(tmp_path, FAKE_TOOL)
    measure_external(scene, "sog", command=command, sh_iterations=3)
    measure_external(scene, "sog", command=command)
    calls = (tmp_path / "tool.log").read_text().splitlines()
    assert calls == [
        "-g cpu -w -i 3 scene.sog",
        "-g cpu -w unpacked.ply",
        "-g cpu -w scene.sog",
        "-g cpu -w unpacked.ply",
    ]


def test_an_error_names_the_missing_tool(scene):
    with pytest.raises(UnsupportedError, match=r"cannot start no-such-tool: .*npm install"):
        measure_external(scene, "spz", command=["no-such-tool"])


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("import sys; print('first', file=sys.stderr); sys.exit('out of splats')", r"\(status 1\): out of splats"),
        ("print('wrote nothing')", r"to \.spz \(status 0\): wrote nothing"),
        ("", "no message"),
    ],
)
def test_an_error_quotes_the_failing_tool(scene, tmp_path, code, message):
    with pytest.raises(UnsupportedError, match=message):
        measure_external(scene, "spz", command=tool(tmp_path, code))


def test_unknown_formats_and_missing_scenes_are_refused(scene, tmp_path):
    with pytest.raises(UnsupportedError, match="'ksplat'; choose sog or spz"):
        measure_external(scene, "ksplat")
    with pytest.raises(InvalidSceneError):
        measure_external(tmp_path / "absent.ply", "spz", command=[sys.executable])


@pytest.mark.skipif(not SPLAT_TRANSFORM.exists(), reason="scripts/setup dev installs splat-transform")
def test_the_real_tool(scene):
    result = measure_external(scene, "spz", command=[node(), str(SPLAT_TRANSFORM)])
    assert result.kept == 1000
    assert 10 < result.bytes_per_gaussian < 40
    assert result.errors.rotation_degrees.rmse < 0.3
    assert result.errors.means.rmse < 2**-12
