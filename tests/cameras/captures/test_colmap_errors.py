"""Oracle: the expected message for each error in a model; and mutated files, which may raise no other exception."""

import os
import struct

import pytest
from helpers.examples import examples
from helpers.memory import takes_less_than
from helpers.reference_cameras import PINHOLE, camera_bytes, image_bytes, poses, write_binary, write_text
from hypothesis import given
from hypothesis import strategies as st

from kissgs.cameras.captures import colmap
from kissgs.cameras.captures.colmap import read_colmap
from kissgs.cameras.captures.load import load_views
from kissgs.core.errors import InvalidViewsError, KissgsError, UnsupportedError

CAMERAS, IMAGES = {1: PINHOLE}, poses(["a.jpg", "b.jpg"])
GOOD_CAMERAS, GOOD_IMAGES = camera_bytes(CAMERAS), image_bytes(IMAGES)
MEMORY = 5_000_000
"""Memory limit, bytes: the files here are below 1 kB, so only an unchecked count could exceed it."""


def message(folder, kind=InvalidViewsError):
    with pytest.raises(kind) as caught:
        read_colmap(folder)
    return str(caught.value).removeprefix(f"{folder}/")


def binary(folder, *, cameras=GOOD_CAMERAS, images=GOOD_IMAGES):
    (folder / "cameras.bin").write_bytes(cameras)
    (folder / "images.bin").write_bytes(images)
    return folder


def pose_bytes(*numbers, camera=1, name=b"x\0", points=0):
    return struct.pack("<QI7dI", 1, 1, *numbers, camera) + name + struct.pack("<Q", points)


BINARY = {
    "cameras.bin is truncated; copy or export it again": {"cameras": b"\1\0\0"},
    "cameras.bin declares 1,099,511,627,776 cameras, but": {"cameras": struct.pack("<Q", 1 << 40) + GOOD_CAMERAS[8:]},
    "images.bin declares 18,446,": {
        "images": b"\xff" * 8 + image_bytes(poses(["a" * 60, "b" * 10], seed=3)[:2])[8:170]
    },
    "cameras.bin has two cameras with number 1; it is": {"cameras": struct.pack("<Q", 2) + 2 * GOOD_CAMERAS[8:]},
    "cameras.bin continues for 3 bytes after its last camera; it is damaged,": {"cameras": GOOD_CAMERAS + b"abc"},
    "images.bin continues for 1 bytes after its last image; it is damaged, export it": {"images": GOOD_IMAGES + b"a"},
    "images.bin is truncated; copy or export it again": {"images": pose_bytes(1, 0, 0, 0, 0, 0, 0, points=1 << 60)},
    "images.bin, image 'x': there is no camera 9 in": {"images": pose_bytes(1, 0, 0, 0, 0, 0, 0, camera=9)},
    "images.bin, image 'x': its pose has a zero quaternion or non-finite": {"images": pose_bytes(0, 0, 0, 0, 0, 0, 0)},
    "images.bin: the name": {"images": pose_bytes(1, 0, 0, 0, 0, 0, 0, name=b"x" * 25)[:-8]},
    "images.bin, name '�': not UTF-8 text; rename the": {"images": pose_bytes(1, 0, 0, 0, 0, 0, 0, name=b"\xff\0")},
    "images.bin has no images; reconstruct the capture again": {"images": bytes(8)},
    "cameras.bin, camera 1: 0x80 pixels is": {"cameras": camera_bytes({1: ("PINHOLE", 0, 80, (1.0, 1.0, 1.0, 1.0))})},
    "cameras.bin, camera 1: the parameters": {"cameras": camera_bytes({1: ("PINHOLE", 9, 8, (1e999, 1.0, 1.0, 1.0))})},
}


@pytest.mark.parametrize("sentence", BINARY)
def test_binary(tmp_path, sentence):
    assert message(binary(tmp_path, **BINARY[sentence])).startswith(sentence)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_poses_of_infinite_numbers(tmp_path, value):
    for index in range(7):
        numbers = [1.0] * 7
        numbers[index] = value
        assert "its pose has" in message(binary(tmp_path, images=pose_bytes(*numbers)))


def test_unknown_model_numbers(tmp_path):
    cameras = struct.pack("<QIiQQ3d", 1, 5, 12, 10, 10, 1, 2, 3)
    assert message(binary(tmp_path, cameras=cameras), UnsupportedError) == (
        "cameras.bin: camera 5 has the unknown model number 12; run 'colmap image_undistorter' first"
    )


TEXT = {
    "cameras.txt, line 1: not a camera (CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS…)": {"cameras": "1 PINHOLE 120"},
    "cameras.txt, line 2: not a camera (CAMERA_ID MODEL WIDTH": {"cameras": "# here\none PINHOLE 120 80 1 1 1 1"},
    "cameras.txt, line 2: a second camera with number 1;": {"cameras": "1 PINHOLE 9 8 1 1 1 1\n1 PINHOLE 9 8 1 1 1 1"},
    "cameras.txt, line 1: not UTF-8 text; rename the photographs or save the file as UTF-8": {"cameras": "\udcff"},
    "cameras.txt, camera 1: PINHOLE has 4 parameters, not 3": {"cameras": "1 PINHOLE 120 80 1 1 1"},
    "images.txt, line 1: not an image (IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME)": {"images": "1 1 0 0 0 0 0 0 1"},
    "images.txt, line 2: expected the points of the": {"images": "1 1 0 0 0 0 0 0 1 a.jpg\n2 1 0 0 0 0 0 0 1 b.jpg"},
    "images.txt, line 3: not an image (IMAGE_ID": {"images": "1 1 0 0 0 0 0 0 1 a.jpg\n\n2 one 0 0 0 0 0 0 1 b.jpg"},
    "images.txt has no images; reconstruct the capture again": {"images": "# nothing\n\n"},
}


@pytest.mark.parametrize("sentence", TEXT)
def test_text(tmp_path, sentence):
    write_text(tmp_path, CAMERAS, IMAGES)
    for name, text in TEXT[sentence].items():
        (tmp_path / f"{name}.txt").write_bytes(text.encode("utf-8", "surrogateescape"))
    assert message(tmp_path).startswith(sentence)


def test_lines_beyond_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(colmap, "MAX_LINE_BYTES", 100)
    write_text(tmp_path, CAMERAS, IMAGES)
    (tmp_path / "images.txt").write_text("1" * 101)
    assert message(tmp_path) == "images.txt, line 1: longer than the limit of 100 bytes; the file is damaged"


def test_missing_files_and_folders_instead_of_files(tmp_path):
    with pytest.raises(InvalidViewsError, match=r"^cannot read .*cameras.txt: there is no such file$"):
        read_colmap(tmp_path)
    os.mkfifo(tmp_path / "cameras.txt")  # nothing waits for a writer of the pipe
    with pytest.raises(InvalidViewsError, match=r"^cannot read .*cameras.txt: it is a folder or a device$"):
        read_colmap(tmp_path)
    write_text(tmp_path / "model", CAMERAS, IMAGES)
    (tmp_path / "model" / "images.txt").unlink()
    with pytest.raises(InvalidViewsError, match=r"has cameras.txt but no images.txt; a COLMAP model needs both$"):
        load_views(tmp_path / "model")


def test_invalid_focal_lengths(tmp_path):
    write_binary(tmp_path, {1: ("PINHOLE", 120, 80, (-1.0, 1.0, 60.0, 40.0))}, IMAGES)
    with pytest.raises(InvalidViewsError) as caught:
        load_views(tmp_path)
    assert (
        str(caught.value)
        == f"{tmp_path}/images.bin, image 'a.jpg': a camera's focal lengths must be positive, and at most 1e+15 pixels"
    )


def test_every_truncation_is_detected(tmp_path):
    for cut in range(len(GOOD_CAMERAS)):
        message(binary(tmp_path, cameras=GOOD_CAMERAS[:cut]))
    for cut in range(len(GOOD_IMAGES)):
        message(binary(tmp_path, images=GOOD_IMAGES[:cut]))


def check(folder):
    """Load the capture; fail on exceptions other than KissgsError and on use of much memory."""
    results = []

    def run():
        try:
            results.append((load_views(folder), ""))
        except KissgsError as error:
            results.append((None, str(error)))

    assert takes_less_than(MEMORY, run)
    views, sentence = results[0]
    assert "\n" not in sentence
    assert views is None or all(view.camera.width >= 1 for view in views.train)


@st.composite
def mutated(draw, data):
    data = bytearray(data)
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(data)))
        stop = min(len(data), start + draw(st.sampled_from([0, 1, 2, 8, 100])))
        data[start:stop] = draw(
            st.binary(max_size=12) | st.sampled_from([b"\xff" * 8, b" nan ", b"\n", b"-1", b"1e999"])
        )
    return bytes(data)


FUZZ = examples(200)


@FUZZ
@given(cameras=mutated(GOOD_CAMERAS), images=mutated(GOOD_IMAGES), which=st.sampled_from(["cameras", "images", "both"]))
def test_mutated_binaries(tmp_path, cameras, images, which):
    binary(
        tmp_path,
        cameras=GOOD_CAMERAS if which == "images" else cameras,
        images=GOOD_IMAGES if which == "cameras" else images,
    )
    check(tmp_path)


@FUZZ
@given(data=st.data(), which=st.sampled_from(["cameras.txt", "images.txt"]))
def test_mutated_texts(tmp_path, data, which):
    write_text(tmp_path, CAMERAS, IMAGES)
    path = tmp_path / which
    path.write_bytes(data.draw(mutated(path.read_bytes())))
    check(tmp_path)
