"""Oracle: a copy of camera_to_JSON of 3DGS, and an independent pinhole projection."""

import json

import numpy as np
import pytest

from kissgs.cameras.captures.transforms_json import (
    camera_as_dict,
    is_camera_file,
    pick_view,
    read_cameras,
    view_of_file,
    write_camera,
)
from kissgs.cameras.views import View, Views, black
from kissgs.core.errors import InvalidViewsError, OutputError
from kissgs.rendering.camera import Camera, look_at


def some_camera(seed=0):
    rng = np.random.default_rng(seed)
    camera = look_at(rng.normal(0, 3, 3), rng.normal(0, 1, 3), np.array([0, -1.0, 0.2]), fov=1.1, width=97, height=61)
    K = camera.K + np.array([[0, 0, 3.3], [0, 5.5, -1.7], [0, 0, 0]])
    return Camera(camera.viewmat, K, 97, 61)


def inrias_entry(number, R, T, width, height, fov_x, fov_y):
    """Return what camera_to_JSON of graphdeco-inria/gaussian-splatting does; R goes to the world, T from it."""
    Rt = np.zeros((4, 4))
    Rt[:3, :3] = R.transpose()
    Rt[:3, 3] = T
    Rt[3, 3] = 1.0
    W2C = np.linalg.inv(Rt)
    return {
        "id": number,
        "img_name": f"DSC_{number:04}",
        "width": width,
        "height": height,
        "position": W2C[:3, 3].tolist(),
        "rotation": [row.tolist() for row in W2C[:3, :3]],
        "fy": height / (2 * np.tan(fov_y / 2)),
        "fx": width / (2 * np.tan(fov_x / 2)),
    }


def inrias_entries(count=3):
    entries = []
    for number in range(count):
        camera = some_camera(number)
        entries.append(inrias_entry(number, camera.viewmat[:3, :3].T, camera.viewmat[:3, 3], 980, 545, 1.2, 0.8))
    return entries


def written(path, document):
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return path


def refusal(path, document=None):
    with pytest.raises(InvalidViewsError) as caught:
        read_cameras(path if document is None else written(path, document))
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


def test_cameras_survive_a_round_trip(tmp_path):
    camera = some_camera()
    write_camera(tmp_path / "here.json", camera)
    (found,) = read_cameras(tmp_path / "here.json")
    assert found.name == "here"
    assert np.array_equal(found.camera.viewmat, camera.viewmat)
    assert np.array_equal(found.camera.K, camera.K)
    assert (found.camera.width, found.camera.height) == (97, 61)
    assert json.loads((tmp_path / "here.json").read_text()) == camera_as_dict(camera)
    with pytest.raises(OutputError, match="exists already"):
        write_camera(tmp_path / "here.json", camera)
    write_camera(tmp_path / "here.json", some_camera(1), overwrite=True)
    assert not np.array_equal(read_cameras(tmp_path / "here.json")[0].camera.viewmat, camera.viewmat)


def test_cameras_of_3dgs_project_points_correctly(tmp_path):
    entries = inrias_entries()
    views = read_cameras(written(tmp_path / "cameras.json", entries))
    assert [view.name for view in views] == ["DSC_0000", "DSC_0001", "DSC_0002"]
    rng = np.random.default_rng(3)
    for entry, view in zip(entries, views, strict=True):
        axes = np.array(entry["rotation"]).T  # each row is an axis of the camera, in world coordinates
        for _ in range(5):
            ahead = np.array([*rng.uniform(-0.3, 0.3, 2), 1]) * rng.uniform(1, 9)
            point = np.array(entry["position"]) + ahead[0] * axes[0] + ahead[1] * axes[1] + ahead[2] * axes[2]
            u = entry["fx"] * ahead[0] / ahead[2] + 980 / 2
            v = entry["fy"] * ahead[1] / ahead[2] + 545 / 2
            x, y, z = view.camera.K @ (view.camera.viewmat[:3, :3] @ point + view.camera.viewmat[:3, 3])
            assert (x / z, y / z) == (pytest.approx(u), pytest.approx(v))


def test_entries_without_a_name(tmp_path):
    entry = {key: value for key, value in inrias_entries(1)[0].items() if key not in ("id", "img_name")}
    assert [view.name for view in read_cameras(written(tmp_path / "single.json", entry))] == ["single"]
    names = [view.name for view in read_cameras(written(tmp_path / "list.json", [entry, entry]))]
    assert names == ["list_0", "list_1"]


def test_selection_from_a_camera_file(tmp_path):
    path = written(tmp_path / "cameras.json", inrias_entries())
    assert [is_camera_file(which) for which in ("a.json", "A.JSON:0", "a.json:b", "a", "7")] == [True] * 3 + [False] * 2
    assert view_of_file(f"{path}:2").name == view_of_file(f"{path}:DSC_0002").name == "DSC_0002"
    with pytest.raises(InvalidViewsError, match=r"has 3 cameras; select one, as in .*cameras\.json:0 or .*:DSC_0000"):
        view_of_file(str(path))
    with pytest.raises(InvalidViewsError, match="numbers go from 0 to 2"):
        view_of_file(f"{path}:3")


def test_selection_by_name_number_and_file_name():
    camera = some_camera()
    names = ("images/7.png", "left/a.png", "right/a.png", "right/b.png", "1")
    parts = tuple(View(name, camera) for name in names)
    views = Views(parts[1:], parts[:1], black(), "x").all
    assert [view.name for view in views] == sorted(names)
    assert pick_view(views, "images/7.png", "x").name == "images/7.png"
    assert pick_view(views, "b.png", "x").name == pick_view(views, "b", "x").name == "right/b.png"
    assert pick_view(views, "0", "x").name == "1", "a number is an index"
    assert pick_view(views, "1", "x").name == "1", "unless it is a name"
    decomposed = View("images/u\u0308.png", camera)
    assert [pick_view([decomposed], which, "x") for which in ("images/ü.png", "ü.png", "ü")] == [decomposed] * 3
    for which, sentence in (
        ("7", "from 0 to 4"),
        ("a", "2 views in x have the name 'a'"),
        ("c", "the first is 1, the last"),
    ):
        with pytest.raises(InvalidViewsError, match=sentence):
            pick_view(views, which, "x")


def test_invalid_camera_files_are_rejected_with_the_field(tmp_path):
    path = tmp_path / "camera.json"
    good, entry = camera_as_dict(some_camera()), inrias_entries(1)[0]
    assert "no such file" in refusal(path)
    assert "is not JSON" in refusal(path, "{")
    assert "is not JSON" in refusal(path, "[" * 100_000)
    assert "empty list" in refusal(path, [])
    assert "is not a camera: it has neither" in refusal(path, 3)
    assert "pass it to --views" in refusal(path, {"frames": []})
    assert "camera 1 is not a camera" in refusal(path, [entry, {"fx": 1}])
    assert "camera 0, position[1]: input should be a finite number" in refusal(
        path, json.dumps([{**entry, "position": [0, float("nan"), 0]}])
    )
    assert "fx: input should be greater than 0" in refusal(path, {**entry, "fx": 0})
    assert "width: input should be" in refusal(path, {**good, "width": "9"})
    assert "height: field required" in refusal(path, {key: good[key] for key in ("viewmat", "K", "width")})
    assert "viewmat: list should have at least 4" in refusal(path, {**good, "viewmat": good["viewmat"][:3]})
    assert "must hold a rotation" in refusal(path, {**entry, "rotation": np.diag([1.0, 1, -1]).tolist()})
    assert "0 0 0 1" in refusal(path, {**good, "viewmat": np.transpose(good["viewmat"]).tolist()})
    assert "skew is not supported" in refusal(path, {**good, "K": [[1, 2, 3], [0, 1, 2], [0, 0, 1]]})
    far = 1.7e308 * np.sign(np.array(entry["rotation"])[:, 0])
    assert "finite numbers" in refusal(path, {**entry, "position": far.tolist()})
