"""``bench/paper.py`` on made data sets; reference: the published table, curves as formulas, captures of known views."""

import contextlib
import fcntl
import io
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.reference_cameras import Pose, frames, write_binary, write_json
from helpers.training_scenes import around, cloud
from PIL import Image
from scipy.spatial.transform import Rotation

import kissgs
from bench import paper
from bench.curves import METRICS, Point, append_point, means, ranks, read_points, reduction
from kissgs.evaluation import evaluate
from kissgs.rendering.rasterizer import render

RD = Path(__file__).parents[2] / "shared/data/paper/rd.csv"
published = pytest.mark.skipif(not RD.is_file(), reason=f"there is no {RD}, the published points")

TABLE = {
    "TanksAndTemples": {"popspa-sogxt-ft": "319 131 72", "popspa-sogxt": "227 104 60", "hacpp-44k": "77* 68 -"},
    "MipNeRF360": {"popspa-sogxt-ft": "228 109 64", "popspa-sogxt": "104 73 40", "hacpp-44k": "70 36 -"},
    "DeepBlending": {"popspa-sogxt-ft": "85 98 -", "popspa-sogxt": "- - -", "hacpp-44k": "156 156 -"},
    "SyntheticNeRF": {"popspa-sogxt-ft": "21 14 14", "popspa-sogxt": "10 - -", "hacpp-44k": "- - -"},
}
"""Reduction factors at the quality of INRIA's 3DGS by PSNR, SSIM and LPIPS, as in the table of the paper."""


def point(size, quality, series="ours", scene="_mean", lpips=None, **more):
    names = {"series": series, "dataset": "d", "scene": scene, "tier": str(size)}
    return Point(**names | more, bytes=size, psnr=quality, ssim=quality / 100, lpips=lpips)


@published
def test_reduction_factors_are_the_24_published_ones():
    found = means(read_points(RD))
    curves = {(each.dataset, each.series): [] for each in found}
    for each in found:
        curves[each.dataset, each.series].append(each)
    for dataset, rows in TABLE.items():
        (reference,) = curves[dataset, "inria-ply"]
        for series, row in rows.items():
            assert [reduction(reference, curves[dataset, series], each) for each in METRICS] == row.split()


@published
def test_means_over_scenes_are_the_published_ones():
    points = read_points(RD)
    given = {each.place: each for each in points if each.scene == "_mean"}
    own = means([each for each in points if each.scene != "_mean"])
    assert {each.place for each in own} == set(given)
    for each in own:
        wanted = given[each.place]
        assert each.bytes == pytest.approx(wanted.bytes, abs=1)
        assert each.psnr == pytest.approx(wanted.psnr, abs=2e-4)
        assert each.lpips == pytest.approx(wanted.lpips, abs=2e-4)


@published
def test_published_points_alone_are_printed(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["paper.py", "--published", str(RD)])
    paper.main()
    assert "| MipNeRF360 | popspa-sogxt-ft | 228 | 109 | 64 |" in capsys.readouterr().out


def test_bytes_are_interpolated_in_their_logarithm_on_the_pareto_front():
    """A point no better than a smaller one is left out: with it, 29.1 dB would be between 1,000 and 8,000 bytes."""
    reference = point(1_000_000, 29.1)
    curve = [point(1000, 29.0), point(2000, 29.5), point(8000, 29.2), point(16000, 31.0)]
    for points in (curve, curve[::-1]):
        for metric in ("psnr", "ssim"):
            assert reduction(reference, points, metric) == f"{1e6 / (1000 * 2**0.2):.0f}"


def test_a_bound_and_a_quality_that_is_never_reached():
    reference, curve = point(1_000_000, 30.0, lpips=0.2), [point(4000, 31.0, lpips=0.3), point(9000, 32.0, lpips=0.25)]
    assert reduction(reference, curve, "psnr") == "250*"
    assert reduction(reference, curve, "lpips") == "-", "less LPIPS is better"
    assert reduction(reference, [point(4000, 30.0)], "psnr") == "250", "exactly reached"
    assert reduction(reference, [point(400_000, 31.0)], "psnr") == "2.5*"
    assert reduction(reference, [point(4000, 31.0)], "lpips") == "", "not measured"


def test_means_need_all_scenes_of_the_data_set():
    points = [point(100, 30, scene="a", tier="S"), point(300, 34, scene="b", tier="S")]
    points.append(point(900, 35, scene="a", tier="L"))
    (mean,) = means(points, missing := [])
    assert missing == ["no mean of ours, d L: there is no point of b"]
    assert (mean.bytes, mean.psnr, mean.ssim, mean.lpips, mean.scene) == (200, 32, 0.32, None, "_mean")


def test_ranks_are_half_by_bytes_and_equal_ones_share_theirs():
    found = ranks({"a": point(100, 30), "b": point(200, 31), "c": point(200, 29)})
    assert found == pytest.approx({"a": 0.5 * 1 + 0.5 * 2, "b": 0.5 * 2.5 + 0.5 * 1, "c": 0.5 * 2.5 + 0.5 * 3})


def test_points_survive_their_file(tmp_path):
    points = [point(100, 30.123456789, lpips=0.25), point(200, 31.0)]
    for each in (point(100, 1.0), *points):
        append_point(tmp_path / "points.csv", each)
    assert read_points(tmp_path / "points.csv") == points, "a later point replaces an earlier one"
    (tmp_path / "points.csv").write_text("series,dataset,scene,tier,bytes,psnr,ssim,lpips\na,b,c,d,many,1,1,1\n")
    with pytest.raises(kissgs.KissgsError, match=r"line 2 of .*points\.csv is no point of a curve \(bytes"):
        read_points(tmp_path / "points.csv")


# Made data sets of each layout, one of two scenes.

COLMAP = {"MipNeRF360": "images images_4", "DeepBlending": "images"}
SCENES = {"MipNeRF360": ("one", "two"), "DeepBlending": ("one",), "SyntheticNeRF": ("one",)}
VIEWS = around(10, size=32)
FEW = {
    "compact": {"sparsify_steps": 2, "refine_steps": 2, "admm_interval": 1},
    "encode": {"plas_radius_decay": 0.5, "sh_kmeans_iterations": 1},
    "finetune": {"steps": 2, "batch": 1, "pras_at": [0.5]},
}


def photographs(scene, folder, names, size=1, white=False):
    """Write renderings, of which white ones are transparent where the scene is."""
    folder.mkdir(parents=True)
    for view, name in zip(VIEWS, names, strict=True):
        camera = view.camera.resized(view.camera.width // size, view.camera.height // size)
        colour, alpha = render(scene, camera)
        straight = colour / np.maximum(alpha[:, :, None], 1e-6)
        image = np.concatenate([straight, alpha[:, :, None]], axis=2) if white else colour
        Image.fromarray(np.uint8(image.clip(0, 1) * 255 + 0.5)).save(folder / name)


def write_colmap(scene, folder, images):
    names = [f"{n:02d}.png" for n in range(len(VIEWS))]
    for each in images:
        photographs(scene, folder / each, names, size=int(each.partition("_")[2] or 1))
    camera = VIEWS[0].camera
    mats = [view.camera.viewmat for view in VIEWS]
    poses = [Pose(name, Rotation.from_matrix(mat[:3, :3]), mat[:3, 3]) for name, mat in zip(names, mats, strict=True)]
    focal, middle = float(camera.K[0, 0]), (camera.width / 2, camera.height / 2)
    write_binary(folder / "sparse/0", {1: ("PINHOLE", camera.width, camera.height, (focal, focal, *middle))}, poses)


def write_synthetic(scene, folder):
    photographs(scene, folder / "all", [f"r_{n}.png" for n in range(len(VIEWS))], white=True)
    angle = 2 * math.atan(VIEWS[0].camera.width / 2 / float(VIEWS[0].camera.K[0, 0]))
    for part, chosen in (("train", range(2, len(VIEWS))), ("test", range(2))):
        mats = {n: VIEWS[n].camera.viewmat for n in chosen}
        poses = [Pose(f"r_{n}", Rotation.from_matrix(mat[:3, :3]), mat[:3, 3]) for n, mat in mats.items()]
        write_json(folder / f"transforms_{part}.json", {"camera_angle_x": angle, "frames": frames(poses, "./all/")})


@pytest.fixture(scope="module")
def manifest(tmp_path_factory):
    """Return a manifest of :data:`SCENES`."""
    folder = tmp_path_factory.mktemp("datasets")
    datasets = {}
    for number, (dataset, names) in enumerate(SCENES.items()):
        datasets[dataset] = {}
        for name in names:
            scene, root = cloud(120, seed=10 * number + len(name) + ord(name[0])), f"{dataset}/{name}"
            if dataset in COLMAP:
                write_colmap(scene, folder / root, COLMAP[dataset].split())
            else:
                write_synthetic(scene, folder / root)
            kissgs.save(scene, folder / root / "scene.ply")
            datasets[dataset][name] = {
                "capture": root,
                "training": f"{root}/images_4" if dataset == "MipNeRF360" else root,
                "reference": f"{root}/scene.ply",
                "checkpoints": {
                    "S": {"scene": f"{root}/scene.ply", "count": 60},
                    "L": {"scene": f"{root}/scene.ply"},
                },
            }
    path = folder / "scenes.yaml"
    path.write_text(yaml.safe_dump({"datasets": datasets, "settings": FEW}))
    return path


def run_paper(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["paper.py", *map(str, words)])
    paper.main()
    return capsys.readouterr()


@pytest.fixture(scope="module")
def results(manifest, tmp_path_factory):
    """Return the folder of all points of rate and distortion, and what was said."""
    folder = tmp_path_factory.mktemp("results")
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(io.StringIO()) as said:
        patch.setattr(sys, "argv", ["paper.py", str(manifest), "-o", str(folder)])
        paper.main()
    return folder, said.getvalue()


def test_the_experiments_of_all_data_sets(manifest, results):
    """Bytes are those of files, and quality that of held-out photographs, every eighth, or those of the test split."""
    folder, said = results
    points = {point.place: point for point in read_points(folder / "points.csv")}
    series = ["ply", "sogxt", "sogxt-ft", "sog-kissgs", "spz-kissgs"]
    tiers = [("reference", f"inria-{each}") for each in series[:2]]
    tiers += [(tier, f"popspa-{each}") for tier in "SL" for each in series]
    scenes = [(dataset, name) for dataset, names in SCENES.items() for name in names]
    assert set(points) == {(each, *scene, tier) for scene in scenes for tier, each in tiers}
    assert len(said.splitlines()) == len(points)
    for dataset, name in scenes:
        root = manifest.parent / dataset / name
        scene, views = kissgs.load(root / "scene.ply"), kissgs.load_views(root)
        assert [len(views.test), len(views.train)] == [2, 8]
        assert views.background.tolist() == [dataset == "SyntheticNeRF"] * 3
        small, whole = points["popspa-spz-kissgs", dataset, name, "S"], points["popspa-sogxt", dataset, name, "L"]
        (file,) = (folder / dataset / name / "S").glob("*.spz")
        assert (small.bytes, len(kissgs.load(file, raw_axes=True))) == (file.stat().st_size, 60)
        (made,) = (path for path in (folder / dataset / name / "L").glob("*.zip") if path.stem == whole.key)
        found = kissgs.evaluate(scene, kissgs.decompress(made), views).mean.candidate
        assert (whole.psnr, whole.ssim) == pytest.approx((found.psnr, found.ssim))
        assert points["popspa-ply", dataset, name, "L"].psnr > 50, "the photographs are renderings of the scene"
        assert whole.seconds > 0
        assert "codebook=" in whole.stages
    text = (folder / "tables.md").read_text()
    assert "| DeepBlending | popspa-ply | 1.0 | 1.0 |" in text
    assert "| MipNeRF360 | S | popspa-sogxt-ft |" in text
    assert (folder / "SyntheticNeRF.png").read_bytes().startswith(b"\x89PNG")


def test_a_second_run_makes_what_is_missing_or_has_changed(manifest, results, monkeypatch, capsys):
    folder, _ = results
    again = run_paper(monkeypatch, capsys, manifest, "-o", folder, "--published", folder / "points.csv")
    assert again.err == ""
    assert "published PSNR" in again.out
    document = yaml.safe_load(manifest.read_text())
    document["settings"]["finetune"]["steps"] = 1
    (root := manifest.parent / "changed.yaml").write_text(yaml.safe_dump(document))
    found = run_paper(monkeypatch, capsys, root, "-o", folder, "--scenes", "two", "--tiers", "S")
    assert [line.partition(":")[0] for line in found.err.splitlines()] == ["MipNeRF360/two S, popspa-sogxt-ft"]


def test_lpips_is_added_to_points_without_making_files_again(manifest, results, monkeypatch, capsys):
    folder, _ = results
    words = manifest, "-o", folder, "--scenes", "one", "--tiers", "L"
    run_paper(monkeypatch, capsys, *words)
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*/one/*/*")}
    monkeypatch.setattr(evaluate, "Lpips", lambda device: lambda image, target: 0.25)
    found = run_paper(monkeypatch, capsys, *words, "--lpips")
    assert len(found.err.splitlines()) == 3 * (2 + 5)
    assert "0.2500 (+0.0000)" in found.out
    assert before == {path: path.stat().st_mtime_ns for path in folder.glob("*/one/*/*")}


def test_the_other_studies(manifest, tmp_path, monkeypatch, capsys):
    """The ablation begins with the container of preset paper; merging and pruning leave as many Gaussians."""
    document = yaml.safe_load(manifest.read_text())
    document["datasets"] = {"MipNeRF360": {"one": document["datasets"]["MipNeRF360"]["one"]}}
    document["datasets"]["MipNeRF360"]["gone"] = {"capture": "nowhere", "checkpoints": {"S": {"scene": "no.ply"}}}
    (path := manifest.parent / "one.yaml").write_text(yaml.safe_dump(document))
    strategies = "merge", "merge + refine", "POP + refine", *paper.OF_PAPER, "prunings along the way"
    studies = "--studies", "rd", "ablation", "compaction", "sensitivity", "--strategies", *strategies
    with pytest.raises(SystemExit, match="1"):
        run_paper(monkeypatch, capsys, path, "-o", tmp_path, *studies, "--tiers", "S")
    said = capsys.readouterr()
    assert f"MipNeRF360/gone S: there is no {manifest.parent / 'no.ply'}\n" in said.err
    points = {point.series: point for point in read_points(tmp_path / "points.csv")}
    for one, other in (("without: nothing", "popspa-sogxt"), ("fine-tuning: as it is", "popspa-sogxt-ft")):
        assert (points[one].bytes, points[one].psnr) == (points[other].bytes, points[other].psnr)
    assert points["without: WebP"].bytes > points["without: nothing"].bytes
    assert points["compaction: POPSpa"].psnr == points["popspa-ply"].psnr
    assert len({points[f"compaction: {name}"].psnr for name in strategies}) == len(strategies)
    assert {points[f"compaction: {name}"].bytes for name in strategies} == {points["popspa-ply"].bytes}
    rows = [line for line in said.out.splitlines() if line.startswith("| all |")]
    assert len(rows) == len(strategies)
    assert "| +104.2 % | +0.0097 |" in said.out, "the published change of bytes and PSNR"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("datasets: [", "is no YAML"),
        ("[]", "the file: must be a mapping"),
        ("datasets: {d: {s: {checkpoints: {}}}}", "datasets.d.s.capture: is missing"),
        ("datasets: {d: {s: {capture: a, checkpoints: {L: {scene: a, size: 3}}}}}", "size: is unknown"),
        ("{datasets: {}, settings: {encoder: {}}}", "settings.encoder"),
        ("datasets: {../d: {}}", "datasets.../d: is no name"),
        ("datasets: {d: {_mean: {capture: a}}}", "datasets.d._mean: is no name"),
        ("datasets: {d: {}, d: {}}", "'d' is there twice"),
        ("datasets: {d: {s: {capture: a, checkpoints: {reference: {scene: a.ply}}}}}", "'reference' is the tier"),
        ("datasets: {d: {s: {capture: a, checkpoints: {L: {scene: a.spz}}}}}", "a.spz is no plain .ply"),
        ("datasets: {d: {s: {capture: a, checkpoints: {L: {scene: a, count: 0}}}}}", "count"),
        ("datasets: {d: {s: {capture: a, checkpoints: {L: {scene: a, count: 9, ratio: 0.5}}}}}", "give one"),
        ("{datasets: {}, settings: {compact: {ratio: 0.5}}}", "give count or ratio to checkpoints"),
    ],
)
def test_a_wrong_manifest_is_one_sentence(tmp_path, text, reason):
    (path := tmp_path / "wrong.yaml").write_text(text)
    with pytest.raises(kissgs.KissgsError) as refused:
        paper.read_manifest(path)
    assert reason in str(refused.value)
    assert str(refused.value).startswith(str(path))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("preset", "words", "reason"),
    [
        ("balanced", ("--studies", "ablation"), "the ablation leaves out parts of preset paper, not of balanced"),
        ("balanced", ("--studies", "sensitivity"), "gaussians_per_codebook_entry has no effect"),
        ("fast", ("--studies", "compaction"), "needs training steps, which preset fast does not have"),
        ("paper", ("--scenes", "three"), "--scenes: the manifest has no 'three'; it has one, two"),
        ("paper", ("--tiers", "M"), "--tiers: the manifest has no 'M'; it has L, S, reference"),
    ],
)
def test_what_cannot_be_made_is_refused_before_any_work(manifest, tmp_path, monkeypatch, capsys, preset, words, reason):
    document = yaml.safe_load(manifest.read_text())
    (path := manifest.parent / "refused.yaml").write_text(yaml.safe_dump(document | {"preset": preset, "settings": {}}))
    with pytest.raises(kissgs.KissgsError, match=re.escape(reason)):
        run_paper(monkeypatch, capsys, path, "-o", tmp_path / "out", *words)
    assert not (tmp_path / "out").exists()


def small(manifest, **changes):
    """Return a manifest of one tier of one scene without a reference, with changes."""
    scene = yaml.safe_load(manifest.read_text())["datasets"]["DeepBlending"]["one"]
    scene |= {"checkpoints": {"S": scene["checkpoints"]["S"]}, "reference": None}
    (path := manifest.parent / "small.yaml").write_text(
        yaml.safe_dump({"datasets": {"d": {"one": scene | changes}}, "settings": FEW})
    )
    return path


def test_files_are_made_again_unless_whole(manifest, tmp_path, monkeypatch, capsys):
    """A file counts with its record and of the size there; a line of points.csv if it was written to its end."""
    path, table = small(manifest), tmp_path / "points.csv"
    run_paper(monkeypatch, capsys, path, "-o", tmp_path)
    before = [(each.place, each.bytes, each.psnr) for each in read_points(table)]
    files = {each.suffix: each for each in (tmp_path / "d/one/S").iterdir() if each.suffix in (".ply", ".sog", ".spz")}
    wanted = {ending: each.read_bytes() for ending, each in files.items()}
    files[".sog"].write_bytes(b"half")
    files[".spz"].with_name(files[".spz"].name + ".json").write_bytes(b"")
    files[".ply"].unlink()
    table.write_bytes(table.read_bytes().splitlines(keepends=True)[0] + b"popspa-ply,d,on")
    said = run_paper(monkeypatch, capsys, path, "-o", tmp_path).err
    assert said.startswith(f"the last line of {table} is incomplete and dropped\n")
    assert {ending: each.read_bytes() for ending, each in files.items()} == wanted
    assert [(each.place, each.bytes, each.psnr) for each in read_points(table)] == before
    table.write_text("series,dataset\n")
    with pytest.raises(kissgs.KissgsError, match=r"points.csv has other columns than this version writes; rename it"):
        run_paper(monkeypatch, capsys, path, "-o", tmp_path)
    with (tmp_path / ".lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(kissgs.KissgsError, match="another run writes to"):
            run_paper(monkeypatch, capsys, path, "-o", tmp_path)


def test_a_failed_compaction_is_tried_once(manifest, tmp_path, monkeypatch, capsys):
    calls = []

    def compact(*given, **more):
        calls.append(given)
        raise kissgs.KissgsError("no memory")

    monkeypatch.setattr(kissgs, "compact", compact)
    with pytest.raises(SystemExit) as ended:
        run_paper(monkeypatch, capsys, small(manifest), "-o", tmp_path)
    assert (ended.value.code, len(calls)) == (1, 1)
    assert capsys.readouterr().err.count(": no memory\n") == 5


def test_a_capture_without_held_out_photographs_is_refused(manifest, tmp_path, monkeypatch, capsys):
    """Otherwise quality would be that towards renderings of the scene, in the same column."""
    write_colmap(cloud(9, seed=1), manifest.parent / "bare", [])
    with pytest.raises(SystemExit):
        run_paper(monkeypatch, capsys, small(manifest, capture="bare"), "-o", tmp_path)
    assert capsys.readouterr().err.count("bare has no held-out photographs to compare with") == 1
    assert not (tmp_path / "points.csv").exists()


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        (b"a,b,c,d,1,1,1,1,1\n", "another number of cells"),
        (b"a,b,c,d,inf,1,1,1\n", "bytes: input should be a finite number"),
        (b"\xff,b,c,d,1,1,1,1\n", "is no table of points"),
        (b'"a,b,c,d,1,1,1,1\n', "is no table of points"),
    ],
)
def test_a_wrong_table_is_one_sentence(tmp_path, row, reason):
    (path := tmp_path / "points.csv").write_bytes(b"series,dataset,scene,tier,bytes,psnr,ssim,lpips\n" + row)
    with pytest.raises(kissgs.KissgsError, match=reason) as refused:
        read_points(path)
    assert "\n" not in str(refused.value)


def test_what_is_not_finite_is_not_measured():
    curve = [point(1000, math.inf), point(2000, 30.0), point(500, math.nan)]
    assert reduction(point(60_000, 30.0), curve, "psnr") == "30"
    assert ranks({"a": point(100, math.nan), "b": point(200, 31)}) == {"a": 0.5, "b": 1.0}


def test_tables_have_ranks_of_whole_groups_and_changes_from_the_named_base():
    names = "POP", "merge"
    whole = [point(100 + n, 30.0, f"compaction: {name}", tier="S") for n, name in enumerate(names)]
    text = paper.study_table([*whole, point(90, 29.0, "compaction: POP", tier="L")], "compaction", ("merge",))
    rows = {tuple(cells[:3]): cells[3:] for cells in (line.strip("| ").split(" | ") for line in text.splitlines())}
    assert rows["d", "S", "POP"][:3] == ["100", "-1.0 %", "30.0000 (+0.0000)"]
    assert rows["d", "L", "POP"][:3] == ["90", "", "29.0000"], "there is no merge to compare with"
    assert [rows["all", "", name][-1] for name in names] == ["1.25", "1.75"], "of tier S alone"
