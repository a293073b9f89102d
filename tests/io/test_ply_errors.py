"""Oracle: for each way in which bytes can be wrong, the beginning of the sentence that a user should read."""

import os
from pathlib import Path

import pytest
from helpers.memory import takes_less_than
from helpers.reference_ply import declaration, header_bytes, names, ply_bytes, random_columns

from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.io import ply_rows as ply_body
from kissgs.io.ply import read_ply, read_ply_info
from kissgs.io.scene_format import ReadOptions

VERTEX = ["element vertex 1", *(f"property float {name}" for name in names(0))]
ROW = b"0 " * 14


def with_rest(count):
    return header_bytes([*VERTEX, *(f"property float f_rest_{i}" for i in range(count))])


NO_PLY = "is not a PLY file: its first line is not 'ply', and no other format is recognised; a .splat needs this ending"
NOT_A_PLY = {
    b"": "is empty; export or download it again",
    b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n": "is not a PLY file: this is a Git",
    b"\xef\xbb\xbf\n<!DOCTYPE html><html>": "is not a PLY file: this is an HTML page, download the file that it links",
    b"<html><head>": "is not a PLY file: this is an HTML page, download the file that it links to",
    b"\x1f\x8b\x08\x00": "is not a PLY file: this is compressed with gzip, unpack it first",
    b"PK\x03\x04\x14\x00": "is not a PLY file: this is a ZIP archive, unpack it or name the scene by its real",
    "ply\nformat ascii 1.0\n".encode("utf-16"): "is not a PLY file: this is text in UTF-16, save it as ASCII or UTF-8",
    b"solid cube\n": NO_PLY,
    b"ply": NO_PLY,
    b"plywood\n": NO_PLY,
    b"ply\nformat ascii 1.0\nelement ver": "has no end_header line; it is cut short or not a PLY file",
    b"ply\nformat ascii 1.0\n": "has no end_header line; it is cut short or not a PLY file",
    b"ply\ncomment " + b"x" * (1 << 20): "has no end_header line within 1048576 bytes; it is damaged",
    b"ply\nelement vertex 0\nend_header\n": "has no format line in its header; export the scene again",
    b"ply\nformat binary 1.0\n": ", header line 2: unknown format 'binary'; it is ascii, binary_little_endian or",
    b"ply\nformat ascii 1.0\ncomment\nformat binary_little_endian 1.0\n": ", header line 4: the format is",
    b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nformat binary_big_endian 1.0\n": (
        ", header line 4: the format is binary_big_endian, and before it was binary_little_endian; "
        "delete the line that is wrong"
    ),
    b"ply\nformat\n": ", header line 2: 'format' is not a line of a PLY header",
    b"ply\n\x00\xff\n": ", header line 2: '\\x00�' is not a line of a PLY header",
    b"ply\n" + b"verbose" * 10 + b"\n": ", header line 2: 'verboseverboseverboseverboseverboseverb…' is not a line of",
    b"ply\nproperty float x\n": ", header line 2: 'property float x' is not a line of a PLY header",
    b"ply\nelement vertex\n": ", header line 2: 'element vertex' is not a line of a PLY header",
    b"ply\nelement vertex many\n": ", header line 2: the count is 'many', not a whole number from 0 to 10^18",
    b"ply\nelement vertex -1\n": ", header line 2: the count is '-1', not a whole number from 0 to 10^18",
    b"ply\nelement vertex 1_0\n": ", header line 2: the count is '1_0', not a whole number from 0 to 10^18",
    b"ply\nelement vertex 1e6\n": ", header line 2: the count is '1e6', not a whole number from 0 to 10^18",
    b"ply\nelement vertex 1000000000000000000\n": ", header line 2: the count is '1000000000000000000', not a whole",
    b"ply\nelement vertex 0\nelement vertex 0\n": (", header line 3: a second element 'vertex'; each may occur once"),
    b"ply\nelement vertex 0\nproperty float\n": ", header line 3: a property needs a type and a name",
    b"ply\nelement vertex 0\nproperty quad x\n": ", header line 3: unknown type 'quad'; known are char, uchar, short,",
    b"ply\nelement vertex 0\nproperty list long int x\n": ", header line 3: unknown type 'long'; known are char,",
    b"ply\nelement vertex 0\nproperty float x\nproperty int x\n": ", header line 4: a second property 'x'; each may",
}

NOT_A_SCENE = {
    header_bytes(["element points 1", "property float x"]): "has no element 'vertex', so no Gaussians; name a trained",
    header_bytes(["element vertex 0"]): "is a point cloud or a mesh, not a trained 3DGS scene: it has no x, y, z,",
    header_bytes(["element vertex 1", *(f"property float {axis}" for axis in "xyz"), "property uchar red",
                  "property uchar green", "property uchar blue"]): (
        "is a point cloud or a mesh, not a trained 3DGS scene: it has no opacity, scale_0, scale_1, scale_2, rot_0, "
        "rot_1, rot_2, rot_3; name the output of a 3DGS trainer"
    ),
    header_bytes([line for line in VERTEX if not line.endswith(("rot_3", "opacity"))]): "has no opacity, rot_3;",
    header_bytes([*(line for line in VERTEX if "f_dc" not in line), "property float red", "property float green",
                  "property float blue"]): (
        "has no f_dc_0, f_dc_1, f_dc_2; export the scene with all its properties"
    ),
    with_rest(10): "has 10 f_rest properties; SH degrees 0 to 3 have 0, 9, 24 or 45",
    with_rest(12): "has 12 f_rest properties; SH degrees 0 to 3 have 0, 9, 24 or 45",
    with_rest(9).replace(b"f_rest_8", b"f_rest_9"): "has 9 f_rest properties but no f_rest_8; export the scene again",
    header_bytes(VERTEX): "is cut short: it declares 1 Gaussians but has room for 0; export or download it again",
    header_bytes(["element vertex 1234567", *VERTEX[1:]]) + b"\0" * (1200 * 56 + 55): "is cut short: it declares",
    header_bytes(["element vertex 2", *VERTEX[1:]], "ascii") + ROW[:-1] + b"\n" * 40: "is cut short: it declares 2",
    header_bytes(["element vertex 999999999999999999", *VERTEX[1:]], "ascii") + ROW: "is cut short: it declares",
    header_bytes(VERTEX, "ascii") + b"\n" + ROW.replace(b"0 0", b"0.5 zero", 1): ", line 20: 'zero' for y is not a",
    header_bytes(["element vertex 3", *VERTEX[1:]], "ascii") + (ROW + b"\n") * 2 + ROW[:-2]: (
        "is cut short: it declares 3 Gaussians but has room for 2; export or download it again"
    ),
    header_bytes(VERTEX, "ascii") + ROW[:-2] + b"\n" + ROW: ", line 19: 13 values where the header declares 14",
    header_bytes(VERTEX, "ascii") + b"1_0 " + ROW[:-2]: ", lines 19 to 19: not all are rows of numbers",
}  # fmt: skip

NOT_SUPPORTED = {
    with_rest(72): "has SH degree 4; export it with degree 3 or lower",
    with_rest(105): "has SH degree 5; export it with degree 3 or lower",
    header_bytes([line for line in VERTEX if not line.endswith("scale_2")]): "holds 2D Gaussians (no scale_2), which",
    header_bytes([*VERTEX[:4], "property float trbf_center", *VERTEX[4:], "property float motion_0"]): (
        "holds Gaussians that move or change in time (trbf_center, motion_0), which are not supported; export one "
        "moment of the scene as 3D Gaussians"
    ),
    header_bytes([*VERTEX, "property list uchar int i"]): "has a list property in element 'vertex'; export it without",
    header_bytes(["element face 1", "property list uchar int i", *VERTEX]): "has element 'face' with a list property",
    header_bytes(["element vertex 0", *(f"property char p{i}" for i in range(4097))]): ", header line 4100: more than",
}


IN_TIME = {
    "SpacetimeGaussians": ["trbf_center", "trbf_scale", "motion_0", "omega_0", "f_t_0"],
    "4DGS": ["t", "scale_t_0", "rot_r_0"],
    "a 4DGS converter": ["mu_t", "t_scale"],
    "FreeTimeGS": ["motion_0", "t_scale"],
    "4D-Rotor": ["scale_3", "rot_4", "rot_7"],
    "a centre in time": ["t_sigma", "center_t", "time_center", "begin_time", "temporal_scale", "birth", "T"],
    "velocities": ["vx", "vy", "vz", "vel_x", "speed_x", "time", "duration"],
    "deltas": ["delta_x_t0", "delta_rot_0_t1"],
}


@pytest.mark.parametrize("properties", IN_TIME.values(), ids=IN_TIME)
def test_each_property_of_moving_gaussians_is_enough(properties):
    for name in properties:
        with pytest.raises(UnsupportedError, match=rf"in time \({name}\)"):
            read_ply_info(header_bytes([*VERTEX, f"property float {name}"]) + b"\0" * 60)


def cases(table):
    return [pytest.param(data, message, id=message[:60]) for data, message in table.items()]


def sentence_of(data, error, tmp_path):
    """The message about a file of these bytes, checked to be the same about the bytes alone."""
    path = tmp_path / "scene.ply"
    path.write_bytes(data)
    with pytest.raises(error) as of_file:
        read_ply(path)
    with pytest.raises(error) as of_bytes:
        read_ply(data)
    about_file, about_bytes = str(of_file.value), str(of_bytes.value)
    assert about_file.startswith("scene.ply")
    assert about_bytes == about_file.replace("scene.ply", "the data", 1)
    assert type(of_file.value) is error
    return about_file.removeprefix("scene.ply").removeprefix(" ")


@pytest.mark.parametrize(("data", "message"), cases({**NOT_A_PLY, **NOT_A_SCENE}))
def test_invalid(data, message, tmp_path):
    assert sentence_of(data, InvalidSceneError, tmp_path).startswith(message)


@pytest.mark.parametrize(("data", "message"), cases(NOT_SUPPORTED))
def test_unsupported(data, message, tmp_path):
    assert sentence_of(data, UnsupportedError, tmp_path).startswith(message)


def test_a_line_without_end_is_not_collected(monkeypatch):
    monkeypatch.setattr(ply_body, "BLOCK_BYTES", 100)
    with pytest.raises(InvalidSceneError, match=r"^the data, line 19: longer than 100 bytes; it is damaged$"):
        read_ply(header_bytes(VERTEX, "ascii") + b"0" * 300)


def test_more_than_the_limit_is_refused_before_reading():
    data = ply_bytes(random_columns(3, 0))
    assert len(read_ply(data, ReadOptions(max_gaussians=3))) == 3
    with pytest.raises(UnsupportedError, match=r"^the data has 3 Gaussians; the limit is 2: raise it"):
        read_ply(data, ReadOptions(max_gaussians=2))


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_a_great_count_costs_no_memory(encoding):
    columns = {name: [0.0] for name in names(3)}
    lines = ["element vertex 100000000000000000", *declaration("vertex", columns, "float")[1:]]

    def refused():
        with pytest.raises(InvalidSceneError, match="cut short"):
            read_ply(header_bytes(lines, encoding) + b"0 " * 1000)

    assert takes_less_than(1_000_000, refused)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_file_cut_while_it_is_read(encoding, tmp_path, monkeypatch):
    """A mapped file would kill the process here."""
    monkeypatch.setattr(ply_body, "BLOCK_BYTES", 30_000)
    path = tmp_path / "scene.ply"
    path.write_bytes(ply_bytes(random_columns(2000, 0), encoding))

    def cut(stage, fraction):
        os.truncate(path, path.stat().st_size // 2)

    with pytest.raises(InvalidSceneError, match=r"^scene.ply is cut short: it declares 2,000 Gaussians"):
        read_ply(path, progress=cut)


@pytest.mark.parametrize("name", ["missing.ply", "no/such/folder/scene.ply", "nul\0.ply"])
def test_missing_file(name, tmp_path):
    with pytest.raises(InvalidSceneError) as error:
        read_ply(tmp_path / name)
    assert str(error.value) == f"cannot read {tmp_path / name}: there is no such file; name a scene file"


def test_folder_and_pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")
    for path in (tmp_path, tmp_path / "pipe.ply"):
        with pytest.raises(InvalidSceneError) as error:
            read_ply_info(path)
        assert str(error.value) == f"cannot read {path}: it is a folder or a device; name a scene file"


def test_no_permission(tmp_path, monkeypatch):
    """The test does not use chmod, because root may read everything."""
    path = tmp_path / "scene.ply"
    path.write_bytes(b"ply\n")

    def refuse(path, mode):
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(InvalidSceneError) as error:
        read_ply(path)
    assert str(error.value) == f"cannot read {path}: permission denied"


def test_failing_disk(tmp_path, monkeypatch):
    path = tmp_path / "scene.ply"
    path.write_bytes(ply_bytes(random_columns(1, 0)))

    def fail(stage, fraction):
        raise OSError(5, "Input/output error")

    with pytest.raises(InvalidSceneError) as error:
        read_ply(path, progress=fail)
    assert str(error.value) == f"cannot read {path}: input/output error"


def test_the_same_format_line_twice_contradicts_nothing(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(header_bytes([*VERTEX[:1], "format ascii 1.0", *VERTEX[1:]], "ascii") + ROW + b"\n")
    assert len(read_ply(path)) == 1
