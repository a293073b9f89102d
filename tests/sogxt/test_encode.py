"""Oracle: the scene that went in, Pillow's view of the images, PyYAML's of the metadata, and SciPy's cube rotations."""

import io
import json

import numpy as np
import pytest
import yaml
from helpers import reference_decoder
from helpers.codec_scenes import (
    GLANCE,
    PLANES,
    assert_round_trip,
    assert_within,
    constant_scene,
    covariances,
    random_scene,
    replaced,
    unit,
)
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from kissgs import Settings, compress, decompress
from kissgs.core.context import Context
from kissgs.core.positions import signed_log
from kissgs.core.splats import clean
from kissgs.sogxt.encode import encode

IMAGES = [f"{name}.webp" for name in PLANES]


def encoded(splats, preset="fast", **changes):
    return compress(splats, settings=Settings.research(preset, **GLANCE, **changes))


@pytest.mark.parametrize(
    ("count", "preset"), [(1, "balanced"), (9, "paper"), (65, "balanced"), (300, "fast"), (300, "paper")]
)
def test_round_trip_levels_and_padding(count, preset):
    """Errors are within the half steps that are reported, levels span images, and all padding repeats one cell."""
    splats = random_scene(count, 1, seed=count)
    result = encoded(splats, preset, prune_threshold_bits=0)
    assert_round_trip(splats, result)
    assert sorted(result.order) == list(range(count))
    assert_levels_span_their_images(result.files, preset)
    assert_all_padding_repeats_one_active_cell(result.files, count)


@examples(25)
@given(
    st.integers(1, 40),
    st.integers(0, 1000),
    st.floats(1e-3, 10),
    st.floats(1e-3, 10),
    st.floats(1e-3, 0.5),
    st.integers(8, 16),
    st.booleans(),
)
def test_round_trip_for_any_steps(count, seed, coarse, fine, quat_step, bits, shared):
    splats = random_scene(count, 0, seed=seed)
    steps = {"opacity_step": coarse, "scale_step": fine, "sh0_step": coarse, "quat_step": quat_step}
    assert_round_trip(splats, encoded(splats, "fast", means_bits=bits, shared_step_size=shared, **steps))


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_sh_of_scenes_below_the_codebook_size_is_within_its_half_steps(preset):
    splats = random_scene(50, 3, seed=2)
    result = encoded(splats, preset, gaussians_per_codebook_entry=1, rate_distortion=False)
    half = max(result.report.max_quantization_error["f_rest_centroids"])
    assert_within(decompress(result.files).shN, splats.select(result.order).shN, half)


def test_the_steps_asked_for_are_kept():
    splats = random_scene(500, 0, seed=1)
    steps = {"opacity_step": 0.2, "scale_step": 0.11, "quat_step": 0.023, "sh0_step": 0.05}
    half = encoded(splats, **steps).report.max_quantization_error
    for field, step in zip(("opacities", "scales", "quaternions", "f_dc"), steps.values(), strict=True):
        assert max(half[field]) <= step / 2 * (1 + 1e-5)
        assert max(half[field]) > step / 2 * 0.95, "a smaller step than needed costs bytes"


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_the_chosen_form_is_the_same_ellipsoid(preset):
    """The rotation is exact even if ``clean`` left a quaternion a millionth longer than 1, as it may."""
    splats = random_scene(200, 0, seed=6)
    splats = replaced(splats, quats=splats.quats * np.float32(1 + 7e-7))
    assert clean(splats)[0].quats is splats.quats, "near enough to 1"
    result = encoded(splats, preset, quat_step=1e-3, scale_step=1e-3)
    assert result.report.form_error < 1e-6
    found, wanted = decompress(result.files), splats.select(result.order)
    before, after = covariances(wanted.quats, wanted.scales), covariances(found.quats, found.scales)
    error = np.linalg.norm(after - before, axis=(1, 2)) / np.linalg.norm(before, axis=(1, 2))
    assert error.max() < (0.05 if preset == "fast" else 0.2)


def test_invisible_gaussians_are_left_out_and_counted():
    splats = random_scene(100, 0)
    faint = np.full(100, -5.6)
    faint[::3] = np.float32(-np.log(254)) + 1e-3  # opacity just above 1/255
    splats = replaced(splats, opacities=faint)
    result = encoded(splats)
    assert (result.report.count, result.report.invisible, result.report.source_count) == (34, 66, 100)
    assert sorted(result.order) == list(range(0, 100, 3))
    everything = encoded(splats, prune_invisible=False)
    assert (everything.report.count, everything.report.invisible) == (100, 0)


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_ranges_are_those_of_the_data_to_the_last_bit(preset):
    """The smallest level that occurs stands for the minimum, whatever the steps; the largest of the widest channel
    for the maximum, within half a step."""
    splats = random_scene(333, 0, seed=7)
    result = encoded(splats, preset)
    ranges = reference_decoder.ranges_of(yaml.safe_load(result.files["container_meta.yaml"]))
    for field, data in (("opacities", splats.opacities[:, None]), ("f_dc", splats.sh0)):
        low, high = (np.ravel(limit).astype(np.float32) for limit in ranges[field])
        half = np.array(result.report.max_quantization_error[field])
        assert (low == data.min(axis=0)).all()
        if preset == "paper":
            assert (high == data.max(axis=0)).all()
        widest = np.ptp(data, axis=0).argmax()
        assert (data.max(axis=0) <= high + half).all()
        assert abs(high[widest] - data.max(axis=0)[widest]) <= half[widest]
    logs = signed_log(splats.means)
    assert np.float32(ranges["means"][0]) == np.float32(logs.min())
    assert np.float32(ranges["means"][1]) == np.float32(logs.max())


def assert_levels_span_their_images(files, preset):
    """A decoder takes the levels that it sees for the ends of the ranges: no range may end where no level lies."""
    ranges = reference_decoder.ranges_of(yaml.safe_load(files["container_meta.yaml"]))
    tops = {"quaternions": 99, "f_rest_centroids": 99} if preset == "paper" else {}
    for field, (low, high) in ranges.items():
        if field == "means":
            levels = reference_decoder.levels(files, "means_bytes_0", 3) + 256 * reference_decoder.levels(
                files, "means_bytes_1", 3
            )
            assert (levels.min(), levels.max()) == (0, 65535), "some readers divide by 65535"
            continue
        levels = reference_decoder.pixels(files, f"{field}.webp")
        if np.max(np.subtract(high, low)) > 0:
            assert levels.min() == 0
            if preset == "paper":
                assert levels.max() == tops.get(field, 255)
        else:
            assert levels.min() == levels.max()


def assert_all_padding_repeats_one_active_cell(files, count):
    cells = [reference_decoder.pixels(files, f"{name}.webp") for name in PLANES[1:8]]
    cells = np.concatenate([image.reshape(len(image) ** 2, -1) for image in cells], axis=1)
    active = reference_decoder.pixels(files, "active_mask.webp")[:, :, 0].reshape(-1) > 0
    assert active.sum() == count
    padding = {tuple(cell) for cell in cells[~active]}
    assert len(padding) <= 1
    assert padding <= {tuple(cell) for cell in cells[active]}


@pytest.mark.parametrize("count", [256, 20])
def test_quaternions_have_the_levels_that_are_asked_for(count):
    scene = random_scene(500, 0)
    found = encoded(scene, "paper", quat_levels=count)
    levels = reference_decoder.pixels(found.files, "quaternions.webp")
    assert (levels.min(), levels.max()) == (0, count - 1)
    assert_round_trip(scene, found)


@pytest.mark.parametrize("count", [1, 100])
def test_images_have_the_modes_that_decoders_expect(count):
    files = encoded(random_scene(count, 3), "balanced").files
    for name in IMAGES:
        with Image.open(io.BytesIO(files[name])) as image:
            assert image.format == "WEBP"
            assert image.mode == ("RGBA" if name == "quaternions.webp" else "RGB"), name
    labels = reference_decoder.pixels(files, "f_rest_labels.webp")
    side = yaml.safe_load(files["container_meta.yaml"])["meta"]["f_rest_centroids_side"]
    assert labels[:, :, :2].max() < side
    assert (labels[:, :, 2] == 0).all()
    assert set(np.unique(reference_decoder.pixels(files, "active_mask.webp"))) <= {0, 1}


def test_quaternion_images_never_lose_their_fourth_channel():
    """Without varying alpha, libwebp drops the channel and the paper's decoder fails: z is constant here."""
    splats = replaced(random_scene(40, 0), quats=np.tile(unit([[0.9, 0.3, 0.1, 0.2]]), (40, 1)))
    for preset in ("fast", "balanced", "paper"):
        assert reference_decoder.levels(encoded(splats, preset).files, "quaternions", 4).shape[1] == 4


def numbers(value):
    """All numbers below ``value``, and whatever else stands where a number should."""
    return [leaf for item in value for leaf in numbers(item)] if isinstance(value, list) else [value]


def test_files_and_metadata_are_complete():
    splats = random_scene(90, 3)
    files = encoded(splats).files
    assert sorted(files) == sorted(["container_meta.yaml", "meta.json", "scene.json", *IMAGES])
    text = files["container_meta.yaml"].decode("ascii")
    document = yaml.safe_load(text)
    assert document["meta"] == {"grid_side": 16, "f_rest_centroids_side": 8, "image_codec": "webp"}
    ranges = reference_decoder.ranges_of(document)
    lengths = {"opacities": 0, "means": 0, "scales": 3, "quaternions": 4, "f_dc": 3, "f_rest_centroids": 45}
    assert ranges.keys() == lengths.keys()
    for field, limits in ranges.items():
        for limit in limits:
            assert isinstance(limit, list) == (lengths[field] > 0)
            assert {type(number) for number in numbers(limit)} == {float}
            assert len(numbers(limit)) == max(lengths[field], 1)
    ours = document["kissgs"]
    assert (ours["count"], ours["source_count"], ours["sh_degree"]) == (90, 90, 3)
    assert set(ours) == {"version", "count", "source_count", "sh_degree", "changed", "settings"}
    scene = json.loads(files["scene.json"])
    entries = [scene["metadata"], *scene["planes"].values()]
    assert {entry["url"]: entry["bytes"] for entry in entries} == {
        name: len(files[name]) for name in ["meta.json", *IMAGES]
    }


def test_bands_that_are_zero_are_constant_in_the_image():
    half_zero = random_scene(1000, 3)
    half_zero.shN[:, 3:] = 0
    files = encoded(half_zero).files
    entries = reference_decoder.untiled(reference_decoder.pixels(files, "f_rest_centroids.webp"), 8).reshape(64, 3, 15)
    assert (entries[:, :, 3:] == entries[0, 0, 14]).all()


def test_constant_scenes_cost_next_to_nothing():
    sizes = encoded(constant_scene(4000, 3)).report.file_bytes
    assert all(sizes[name] < 150 for name in IMAGES)


def test_progress_names_every_stage_and_ends_at_one():
    events = []
    context = Context(progress=lambda stage, fraction: events.append((stage, fraction)))
    encode(random_scene(300, 3), Settings().encode, context)
    stages = list(dict.fromkeys(stage for stage, _ in events))
    assert stages == ["kernels", "order", "forms", "codebook", "sort codebook", "reorder", "images"]
    assert all(0 <= fraction <= 1 for _, fraction in events)
    assert events[-1] == ("images", 1.0)
