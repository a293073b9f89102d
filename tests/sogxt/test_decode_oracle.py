"""Oracle: two decoders written from the format's description (reference_decoder.py), on made and real scenes."""

import functools

import numpy as np
import pytest
from helpers import reference_decoder
from helpers.codec_scenes import GLANCE, PRESETS, constant_scene, random_scene

from kissgs import Settings, compress, decompress, load
from kissgs.core.splats import ATTRIBUTES

COUNTS = (0, 1, 7, 8, 9, 63, 64, 65, 1000)


def encoded(splats, preset, **settings):
    return compress(splats, settings=Settings.research(preset, **GLANCE, **settings)).files


def check(files):
    """Assert that the decoders of kissgs, the paper and browsers agree on ``files``."""
    ours = decompress(files)
    reference_decoder.assert_equal_scenes(ours, reference_decoder.decode(files), files)
    shown = reference_decoder.decode_browser(files)
    assert shown["means"].shape == ours.means.shape
    lengths = np.linalg.norm(ours.quats.astype(np.float64), axis=1, keepdims=True)
    rest = np.zeros((len(ours), 15, 3))
    rest[:, : ours.shN.shape[1]] = ours.shN
    mine = {name: getattr(ours, name) for name in ATTRIBUTES} | {"quats": ours.quats / lengths, "shN": rest}
    for name, wanted in shown.items():
        np.testing.assert_allclose(mine[name], wanted, rtol=1e-5, atol=1e-5, err_msg=name)
    # Some readers divide positions by 65535 and not by the largest level that they see.
    np.testing.assert_allclose(
        reference_decoder.decode_browser(files, means_top=65535)["means"], shown["means"], rtol=1e-9
    )
    return ours


@pytest.mark.parametrize(("degree", "preset"), list(enumerate(PRESETS)))
def test_every_degree_and_preset(degree, preset):
    count = 64 if preset == "paper" else 300
    ours = check(encoded(random_scene(count, degree, seed=degree), preset))
    assert ours.sh_degree == degree


@pytest.mark.parametrize(("count", "preset"), [(n, ("balanced", "paper")[i % 2]) for i, n in enumerate(COUNTS)])
@pytest.mark.quick(5)
def test_every_count(count, preset):
    files = encoded(
        random_scene(count, 3 if count in (8, 64) else 0, seed=count),
        preset,
        prune_invisible=False,
        prune_threshold_bits=0,
    )
    assert len(check(files)) == count


@pytest.mark.parametrize(("count", "preset"), [(1, "balanced"), (9, "paper"), (100, "fast")])
def test_constant_scenes_decode_exactly(count, preset):
    """Every channel is constant: no image may lose it to a division by zero, or give it another channel's level."""
    splats = constant_scene(count, degree=2)
    ours = check(encoded(splats, preset, prune_threshold_bits=0))
    np.testing.assert_allclose(ours.opacities, splats.opacities, atol=1e-6)
    np.testing.assert_allclose(ours.sh0, splats.sh0, atol=1e-6)
    np.testing.assert_allclose(np.sort(ours.scales, axis=1), np.sort(splats.scales, axis=1), atol=1e-6)


@pytest.mark.parametrize("attribute", ATTRIBUTES)
def test_one_constant_attribute_among_others(attribute):
    splats = random_scene(100, 1, seed=3)
    getattr(splats, attribute)[:] = getattr(splats, attribute)[:1]
    check(encoded(splats, "fast"))


@pytest.mark.parametrize(("channel", "preset"), [(0, "fast"), (1, "paper"), (2, "fast")])
def test_one_constant_channel_beside_others(channel, preset):
    """It shares its image with channels that are not constant: its levels must not matter, its two limits be equal."""
    splats = random_scene(300, 0, seed=4)
    splats.sh0[:, channel] = 0.123456
    ours = check(encoded(splats, preset))
    assert (ours.sh0[:, channel] == np.float32(0.123456)).all()


@functools.cache
def real_scene(path):
    return load(path)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", ["fox/point_cloud.ply", "guitar/guitar.ply"])
@pytest.mark.quick(0)
def test_real_scenes(shared_data, name, preset):
    splats = real_scene(shared_data / name)
    if preset != "fast":  # all of it once; a part of it in the slower presets
        splats = splats.select(slice(None, None, 300))
    ours = check(encoded(splats, preset))
    assert ours.sh_degree == splats.sh_degree


def test_threads_do_not_change_what_is_decoded():
    files = encoded(random_scene(500, 3), "fast")
    one, many = decompress(files, threads=1), decompress(files, threads=3)
    assert all((getattr(one, name) == getattr(many, name)).all() for name in ATTRIBUTES)


def test_padding_amid_the_grid_is_skipped():
    """Only the mask says which cells count; encoders other than ours (PLAS) leave padding anywhere."""
    files = encoded(random_scene(100, 1, seed=8), "paper")
    mask = reference_decoder.pixels(files, "active_mask.webp")[:, :, 0].reshape(-1) > 0
    assert mask.sum() == 100
    assert not mask[:100].all(), "the padding should lie amid the rest"
    check(files)
