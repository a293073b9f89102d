"""Oracle: scenes packed by naive_compressed_ply.py, words unpacked by hand, a scene unpacked by PlayCanvas' tool."""

import math
import random
import struct

import numpy as np
import pytest
from helpers.reference_compressed_ply import SH_C0, compressed_bytes, header_bytes
from helpers.reference_ply import assert_identical

from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.io import ply_rows as ply_body
from kissgs.io.ply import PlyInfo, read_ply, read_ply_info


def random_gaussians(count, rest_count):
    rng = random.Random(f"{count} {rest_count}")

    def unit_quat():
        quat = [rng.gauss(0, 1) for _ in range(4)]
        return [value / math.hypot(*quat) for value in quat]

    return [
        {
            "position": [rng.uniform(-5, 5) for _ in range(3)],
            "quat": unit_quat(),
            "log_scale": [rng.uniform(-8, 1) for _ in range(3)],
            "rgb": [rng.uniform(0, 1) for _ in range(3)],
            "opacity": rng.uniform(0.01, 0.99),
            "rest": [rng.uniform(-3.9, 3.9) for _ in range(rest_count)],
        }
        for _ in range(count)
    ]


@pytest.mark.parametrize(
    ("rest_count", "colour_bounds", "order"), [(0, True, "<"), (9, False, ">"), (24, True, ">"), (45, False, "<")]
)
def test_within_half_a_step(rest_count, colour_bounds, order, monkeypatch):
    """Three chunks, the last one partly filled, and as many blocks."""
    monkeypatch.setattr(ply_body, "BLOCK_BYTES", 5000)
    gaussians = random_gaussians(600, rest_count)
    splats = read_ply(compressed_bytes(gaussians, rest_count, colour_bounds=colour_bounds, order=order))

    def error(values, key):
        return np.abs(values - np.array([g[key] for g in gaussians])).max()

    assert error(splats.means, "position") < 10 / 1023 / 2 * 1.01
    assert error(splats.scales, "log_scale") < 9 / 1023 / 2 * 1.01
    assert error(splats.sh0 * SH_C0 + 0.5, "rgb") < 1 / 255 / 2 * 1.01
    assert error(1 / (1 + np.exp(-splats.opacities.astype(float))), "opacity") < 1 / 255 / 2 * 1.01
    quats = np.array([g["quat"] for g in gaussians])
    assert (np.abs((splats.quats * quats).sum(axis=1)) > 1 - 1e-5).all()
    np.testing.assert_allclose(np.linalg.norm(splats.quats, axis=1), 1, atol=1e-6)
    rest = splats.shN.transpose(0, 2, 1).reshape(600, rest_count)
    if rest_count:
        assert error(rest, "rest") < 8 / 256 / 2 * 1.01


def test_info():
    data = compressed_bytes(random_gaussians(3, 24), 24, order=">")
    assert read_ply_info(data) == PlyInfo(count=3, sh_degree=2, encoding="binary_big_endian", compressed=True)


def one(position=0, rotation=0, scale=0, colour=0, rest=b""):
    """A file of one Gaussian of these words; all bounds are 2 to 4."""
    bounds = struct.pack("<18f", *[2, 2, 2, 4, 4, 4] * 3)
    return header_bytes(1, len(rest)) + bounds + struct.pack("<4I", position, rotation, scale, colour) + rest


def test_bits_of_a_vector():
    word = 0b11111111111_0000000000_00000000000
    np.testing.assert_array_equal(read_ply(one(position=word)).means, [[4, 2, 2]])
    word = 0b00000000000_1111111111_10000000000
    np.testing.assert_array_equal(read_ply(one(scale=word)).scales, np.float32([[2, 4, 2 + 2 * 1024 / 2047]]))


@pytest.mark.parametrize(
    ("largest", "expected"), [(0, [0, 1, 0, 0]), (1, [1, 0, 0, 0]), (2, [1, 0, 0, 0]), (3, [1, 0, 0, 0])]
)
def test_bits_of_a_rotation(largest, expected):
    """The first of the others at its end, sqrt(1/2); the largest has the rest, all but two half steps."""
    word = largest << 30 | 1023 << 20 | 512 << 10 | 512
    half = math.sqrt(0.5)
    quat = np.array(expected) * half
    quat[largest] = half
    np.testing.assert_allclose(read_ply(one(rotation=word)).quats, [quat], atol=1e-3)


def test_a_rotation_that_is_too_long_has_no_largest_part():
    word = 0x3FFFFFFF
    np.testing.assert_allclose(read_ply(one(rotation=word)).quats, [[0, *[math.sqrt(0.5)] * 3]], rtol=1e-6)


@pytest.mark.parametrize(("alpha", "logit"), [(0, -math.inf), (255, math.inf), (51, math.log(0.2 / 0.8))])
def test_bits_of_a_colour(alpha, logit):
    splats = read_ply(one(colour=0xFF000000 | alpha))
    np.testing.assert_allclose(splats.sh0 * SH_C0 + 0.5, [[4, 2, 2]], rtol=1e-6)
    np.testing.assert_allclose(splats.opacities, [logit], rtol=1e-6)


def test_bytes_of_sh_stand_channel_by_channel():
    splats = read_ply(one(rest=bytes([0, 255, 128, 127, 1, 254, 64, 192, 32])))
    r, g, b = [-4, 4, 1 / 64], [-1 / 64, -4 + 3 / 64, 4 - 3 / 64], [-2 + 1 / 64, 2 + 1 / 64, -3 + 1 / 64]
    np.testing.assert_array_equal(splats.shN[0].T, np.float32([r, g, b]))


def test_bounds_that_are_not_numbers_make_no_warning():
    data = one(position=0x12345678)
    broken = data.replace(struct.pack("<3f", 2, 2, 2), struct.pack("<3f", math.nan, math.inf, -math.inf), 1)
    assert not np.isfinite(read_ply(broken).means).any()


def test_no_gaussians():
    splats = read_ply(header_bytes(0, 45))
    assert (len(splats), splats.sh_degree) == (0, 3)


def test_guitar(shared_data):
    """guitar.ply is guitar.compressed.ply unpacked by splat-transform."""
    folder = shared_data / "guitar"
    assert_identical(read_ply(folder / "guitar.compressed.ply"), read_ply(folder / "guitar.ply"))


GOOD = header_bytes(257, 9)

INVALID = {
    GOOD.replace(
        b"element chunk", b"element block"
    ): "is a compressed .ply without element 'chunk'; export or download it again",
    GOOD.replace(b"uint packed_scale", b"int packed_scale"): "is a compressed .ply whose element 'vertex' needs a",
    GOOD.replace(b"max_scale_y", b"max_scale_t"): "is a compressed .ply whose element 'chunk' needs a property",
    GOOD.replace(b"max_b", b"max_blue"): "is a compressed .ply whose element 'chunk' needs a property 'max_b' of type",
    GOOD.replace(b"uchar f_rest_8", b"char f_rest_8"): "is a compressed .ply whose element 'sh' needs a property",
    GOOD.replace(b"f_rest_8", b"f_rest_x"): "has 8 f_rest properties; SH degrees 0 to 3 have 0, 9, 24 or 45",
    header_bytes(257, 9, chunks=1): "has 1 chunks of 256 for 257 Gaussians; export or download it again",
    GOOD.replace(b"element sh 257", b"element sh 256"): "has SH of 256 for 257 Gaussians; export or download it again",
    GOOD + b"\0" * 143: "is cut short: it declares 2 rows of element 'chunk' but has room for 1; export or download",
    GOOD + b"\0" * (2 * 72 + 257 * 16 - 1): "is cut short: it declares 257 Gaussians but has room for 256; export or",
    GOOD + b"\0" * (2 * 72 + 257 * 25 - 1): "is cut short: it declares 257 rows of element 'sh' but has room for 256;",
}


@pytest.mark.parametrize(("data", "message"), list(INVALID.items()), ids=list(INVALID.values()))
def test_invalid(data, message):
    with pytest.raises(InvalidSceneError) as error:
        read_ply(data)
    assert str(error.value).startswith(f"the data {message}")


def test_ascii_is_unsupported():
    data = GOOD.replace(b"binary_little_endian", b"ascii")
    with pytest.raises(UnsupportedError, match=r"^the data is a compressed \.ply in ascii; export it as binary$"):
        read_ply(data)
