"""Oracle: containers put together by hand with Pillow, as other encoders might, and reference_decoder.py."""

import io

import numpy as np
import pytest
import yaml
from helpers import reference_decoder
from helpers.codec_scenes import PLANES, random_scene
from PIL import Image

from kissgs import Cancelled, InvalidContainerError, Settings, compress, decompress
from kissgs.core.splats import ATTRIBUTES
from kissgs.sogxt import CHECKSUM

FILES = compress(random_scene(100, 3, seed=1), settings=Settings.from_preset("paper")).files


def webp(image):
    """Lossless bytes of an image array, by Pillow."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image.astype(np.uint8))).save(buffer, "WEBP", lossless=True, exact=True)
    return buffer.getvalue()


def foreign(files=FILES, **images):
    """The container as another encoder might have left it: without our keys, some images exchanged."""
    document = yaml.safe_load(files["container_meta.yaml"])
    document = {key: value for key, value in document.items() if not key.startswith("kissgs")}
    changed = {f"{name}.webp": webp(image) for name, image in images.items()}
    kept = {name: data for name, data in files.items() if name != "meta.json"}
    return {**kept, **changed, "container_meta.yaml": yaml.safe_dump(document).encode()}


def image_of(name, files=FILES):
    return reference_decoder.pixels(files, f"{name}.webp")


def made_by_hand(count, grid, side, seed=0):
    """A container of random levels with round ranges; ``count`` of the cells, somewhere, are active."""
    rng = np.random.default_rng(seed)
    mask = rng.permutation(np.arange(grid * grid) < count).reshape(grid, grid)
    shape = (grid, grid)
    images = {
        "active_mask": mask * 255,
        **{name: rng.integers(0, 256, (*shape, 3)) for name in ("means_bytes_0", "means_bytes_1", "scales", "f_dc")},
        "opacities": rng.integers(0, 256, shape),
        "quaternions": rng.integers(0, 100, (*shape, 4)),
        "f_rest_labels": np.concatenate([rng.integers(0, side, (*shape, 2)), rng.integers(0, 256, (*shape, 1))], 2),
        "f_rest_centroids": rng.integers(10, 90, (3 * side, 5 * side, 3)),
    }
    ranges = {
        "opacities": (-5.5, 7.25),
        "means": (-3.0, 2.5),
        "scales": ([-9.0, -8.0, -7.0], [-1.0, 0.0, 1.0]),
        "quaternions": ([-1.0, -0.5, 0.0, 0.25], [1.0, 0.5, 0.0, 0.75]),
        "f_dc": ([-1.5, -1.25, -1.0], [3.0, 2.0, 1.0]),
        "f_rest_centroids": (np.linspace(-1, -0.5, 45).tolist(), np.linspace(0.5, 2, 45).tolist()),
    }
    ops = [
        {"input_fields": [field], "transforms": [{"simple_quantize": {"min_values": low, "max_values": high}}]}
        for field, (low, high) in ranges.items()
    ]
    meta = {"grid_side": grid, "f_rest_centroids_side": side, "image_codec": "webp"}
    files = {f"{name}.webp": webp(image) for name, image in images.items()}
    return {**files, "container_meta.yaml": yaml.safe_dump({"meta": meta, "ops": ops}).encode()}


@pytest.mark.parametrize(
    ("count", "grid", "side"),
    [(1, 1, 1), (0, 1, 1), (0, 8, 8), (5, 3, 2), (100, 10, 7), (77, 16, 24), (64, 8, 256), (40_000, 211, 16)],
)
def test_containers_of_any_size_and_any_levels(count, grid, side):
    """Nothing in the format asks for multiples of 8; one scene is larger than what is looked up at a time."""
    files = made_by_hand(count, grid, side)
    found = decompress(files)
    assert len(found) == count
    assert found.sh_degree == 3
    reference_decoder.assert_equal_scenes(found, reference_decoder.decode(files), files)


def test_levels_need_not_span_their_bytes():
    """A decoder must take what it sees for the ends: here levels 40 to 73 of one channel are all there is."""
    levels = np.zeros((16, 16, 3)) + 50
    levels[:, :, 1] = np.random.default_rng(0).integers(40, 74, (16, 16))
    files = foreign(scales=levels)
    reference_decoder.assert_equal_scenes(decompress(files), reference_decoder.decode(files), files)


def test_levels_that_do_not_occur_have_no_value():
    """The largest ranges that float32 holds, from level 200 to 201: on the same line, level 0 would be -1.2e41."""
    levels = np.full((16, 16), 200)
    levels[3, 4] = 201
    document = yaml.safe_load(foreign()["container_meta.yaml"])
    op = next(op for op in document["ops"] if op["input_fields"] == ["opacities"])
    op["transforms"] = [{"simple_quantize": {"min_values": -3e38, "max_values": 3e38}}]
    files = {**foreign(opacities=levels), "container_meta.yaml": yaml.safe_dump(document).encode()}
    assert set(decompress(files).opacities) <= {np.float32(-3e38), np.float32(3e38)}


@pytest.mark.parametrize("value", [1, 7, 255])
def test_any_mask_level_above_zero_is_active(value):
    found = decompress(foreign(active_mask=(image_of("active_mask") > 0) * value))
    assert (found.means == decompress(FILES).means).all()


def test_images_with_a_superfluous_alpha_channel():
    """The paper's decoder fails on them; the colour is as plain as ever."""
    images = {}
    for name in ("means_bytes_0", "means_bytes_1", "scales", "f_dc", "f_rest_labels", "f_rest_centroids"):
        image = image_of(name)
        images[name] = np.concatenate([image, np.full((*image.shape[:2], 1), 200)], axis=2)
    found, wanted = decompress(foreign(**images)), decompress(FILES)
    assert all((getattr(found, key) == getattr(wanted, key)).all() for key in ATTRIBUTES)


def test_labels_between_the_codebook_side_and_its_end_reach_into_the_next_row():
    """The paper's decoder uses entry = row * S + column, even if the column is beyond the row's end."""
    files = made_by_hand(50, 8, 4)
    labels = image_of("f_rest_labels", files)
    labels[0, 0, :2] = 5, 1
    files["f_rest_labels.webp"] = webp(labels)
    reference_decoder.assert_equal_scenes(decompress(files), reference_decoder.decode(files), files)


def refusal(files):
    with pytest.raises(InvalidContainerError) as caught:
        decompress(files)
    return str(caught.value)


@pytest.mark.parametrize("name", PLANES)
def test_an_image_that_is_missing_exchanged_or_of_another_size(name):
    """The checksums are ours; without them, a flipped bit may still decode, to another scene."""
    file = f"{name}.webp"
    found = refusal({k: v for k, v in FILES.items() if k != file})
    assert found == f"the container has no file '{file}'; export or download it again"
    data = bytearray(FILES[file])
    data[-3] ^= 1
    assert refusal({**FILES, file: bytes(data)}).startswith(f"{file} is damaged")
    width, height = (40, 24) if name == "f_rest_centroids" else (16, 16)
    found = refusal(foreign(**{name: image_of(name)[:8, :8]}))
    assert found == f"{file} is 8 x 8 pixels; the metadata asks for {width} x {height}"


@pytest.mark.parametrize("active", [True, False])
def test_labels_outside_the_codebook(active):
    """Padding is checked too: the paper's decoder looks up all cells."""
    labels = image_of("f_rest_labels")
    cell = np.argwhere((image_of("active_mask")[:, :, 0] > 0) == active)[0]
    labels[cell[0], cell[1], :2] = 0, 8
    assert refusal(foreign(f_rest_labels=labels)) == "f_rest_labels.webp points outside the codebook of 8 x 8 entries"


def test_a_mask_that_disagrees_with_the_metadata():
    document = yaml.safe_load(FILES["container_meta.yaml"])
    document["kissgs"]["count"] = 99
    del document[CHECKSUM]
    files = {**foreign(), "container_meta.yaml": yaml.safe_dump(document).encode()}
    assert refusal(files) == "active_mask.webp marks 100 Gaussians; the metadata declares 99"


def test_images_far_larger_than_their_pixels_need():
    padded = FILES["f_dc.webp"] + bytes(10_000)
    assert refusal({**FILES, "f_dc.webp": padded}).startswith("f_dc.webp has ")


def test_progress_is_reported_and_decoding_can_be_cancelled():
    events = []
    decompress(FILES, progress=lambda stage, fraction: events.append((stage, fraction)))
    assert [stage for stage, _ in events] == ["decode"] * len(events)
    fractions = [fraction for _, fraction in events]
    assert fractions == sorted(fractions)
    assert 0 <= fractions[0] < 0.01
    assert fractions[-1] == 1

    def stop(stage, fraction):
        raise Cancelled("enough")

    with pytest.raises(Cancelled, match="enough"):
        decompress(FILES, progress=stop)
