"""The command line: thin, prints what the library returns. Heavy imports wait until a command needs them."""

from __future__ import annotations

import glob
import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from kissgs._version import __version__
from kissgs.errors import KissgsError, OutputError, UnsupportedError

if TYPE_CHECKING:
    from types import FrameType

    from rich.console import RenderableType

    from kissgs.settings import Settings

app = typer.Typer(
    name="kissgs",
    help="Compress 3D Gaussian Splatting scenes (.ply) into SOG-XT containers that any browser can open.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

Scenes = Annotated[list[str], typer.Argument(metavar="FILE…", help="Files or patterns; '-' reads standard input.")]
PresetOption = Annotated[
    str, typer.Option("--preset", "-p", help="[bold]fast[/], [bold]balanced[/], [bold]small[/] or [bold]paper[/].")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Change one setting of the preset; see docs/settings.md."),
]
SeedOption = Annotated[int | None, typer.Option(help="Of all random choices: same input, settings, seed: same bytes.")]
ForceOption = Annotated[bool, typer.Option("--force", "-f", help="Overwrite files that exist.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the report as JSON.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
ThreadsOption = Annotated[int, typer.Option(min=0, help="0: one per processor. The bytes do not depend on it.")]


class _Interrupted(BaseException):
    """Ctrl-C or a request to end: unwinds everything, so that no half-written file stays."""


def main() -> None:
    """Entry point. Errors a user can cause end in one line and exit code 2, Ctrl-C in 130."""
    signal.signal(signal.SIGINT, _interrupt)
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        app()
    except KissgsError as error:
        _fail(error)
    except _Interrupted as reason:
        sys.stderr.write("kissgs: interrupted; nothing half-written is left\n")
        sys.stderr.flush()
        os._exit(128 + reason.args[0])  # threads inside libwebp cannot be stopped, and need not be waited for


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise _Interrupted(number)


@app.command()
def compress(
    scenes: Scenes,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="A .zip, a folder, or '-'; by default the scene's name with .zip."),
    ] = None,
    preset: PresetOption = "balanced",
    changes: SetOption = None,
    seed: SeedOption = None,
    threads: ThreadsOption = 0,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Compress scenes.

    With several scenes, --output is the folder that receives one zip for each.
    """
    from kissgs.pipeline import compress as run

    settings = _settings(preset, changes, seed)
    reports = []
    for scene, target in _pairs(scenes, output, ".zip"):
        piped = str(target) == "-"
        if piped and as_json:
            raise OutputError("--json and -o - would both write to standard output; choose one")
        source = sys.stdin.buffer.read() if scene == "-" else Path(scene)
        with _progress(quiet or as_json) as progress:
            result = run(
                source,
                None if piped else target,
                settings=settings,
                overwrite=force,
                threads=threads,
                progress=progress,
            )
        if piped:
            sys.stdout.buffer.write(result.to_zip())
        elif as_json:
            reports.append({"input": scene, "output": str(target), **result.report.as_dict()})
        elif not quiet:
            from kissgs._tables import report_table

            _print(report_table(result.report, str(target)))
    if as_json:
        _print_json(reports)


@app.command()
def decompress(
    containers: Scenes,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="A .ply or '-'; by default the container's name with .ply."),
    ] = None,
    threads: ThreadsOption = 0,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Turn containers back into .ply files.

    With several containers, --output is the folder that receives one .ply for each.
    """
    from kissgs.io.ply import write_ply
    from kissgs.pipeline import decompress as run

    reports = []
    for container, target in _pairs(containers, output, ".ply"):
        piped = str(target) == "-"
        if piped and as_json:
            raise OutputError("--json and -o - would both write to standard output; choose one")
        source = sys.stdin.buffer.read() if container == "-" else Path(container)
        with _progress(quiet or as_json) as progress:
            splats = run(source, None if piped else target, overwrite=force, threads=threads, progress=progress)
        if piped:
            write_ply(sys.stdout.buffer, splats)
            continue
        reports.append(
            {
                "input": container,
                "output": str(target),
                "count": len(splats),
                "sh_degree": splats.sh_degree,
                "bytes": target.stat().st_size,
            }
        )
        if not (quiet or as_json):
            _print(
                f"{target}  {len(splats):,} Gaussians, SH degree {splats.sh_degree}, {target.stat().st_size:,} bytes"
            )
    if as_json:
        _print_json(reports)


@app.command()
def info(files: Scenes, as_json: JsonOption = False) -> None:
    """Show what .ply files and containers hold."""
    from kissgs._tables import info_table
    from kissgs.info import describe

    found = [describe(Path(name)) for name in _expand(files)]
    if as_json:
        _print_json([item.as_dict() for item in found])
    else:
        for item in found:
            _print(info_table(item))


@app.command()
def sample(
    output: Annotated[Path, typer.Argument(help="The .ply to write.")],
    gaussians: Annotated[int, typer.Option(min=0, help="How many.")] = 60_000,
    degree: Annotated[int, typer.Option(min=0, max=3, help="Of its spherical harmonics.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Another seed makes another scene.")] = 0,
    force: ForceOption = False,
) -> None:
    """Make a sample scene: glossy, textured things on a table."""
    from kissgs.pipeline import save
    from kissgs.sample import sample_scene

    save(sample_scene(gaussians, sh_degree=degree, seed=seed), output, overwrite=force)


@app.command()
def demo(
    scene: Annotated[Path | None, typer.Argument(help="Your own .ply; by default the sample scene.")] = None,
    folder: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")] = Path("demo-out"),
    preset: PresetOption = "balanced",
) -> None:
    """Compress a scene, decompress it, and show what that cost."""
    from kissgs._tables import roundtrip_table
    from kissgs.bench import roundtrip
    from kissgs.pipeline import save
    from kissgs.sample import sample_scene

    settings = _settings(preset, None, None)
    _make_folder(folder)
    with _progress(False) as progress:
        if scene is None:
            scene = folder / "sample.ply"
            save(sample_scene(), scene, overwrite=True, progress=progress)
        container, back = folder / f"{scene.stem}.zip", folder / f"{scene.stem}.decoded.ply"
        result = roundtrip(scene, settings, container=container, back=back, overwrite=True, progress=progress)
    _print(roundtrip_table(result))
    _print(f"\nscene      {scene}\ncontainer  {container}\ndecoded    {back}")


@app.command()
def bench(
    scenes: Scenes,
    presets: Annotated[
        list[str] | None, typer.Option("--preset", "-p", help="Repeat for several; default: all.")
    ] = None,
    peers: Annotated[list[str] | None, typer.Option("--peer", help="sog or spz, by splat-transform.")] = None,
    splat_transform: Annotated[str, typer.Option(help="How to start it.")] = "splat-transform",
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure bytes, time, memory and errors of presets and of other tools, each in a process of its own."""
    import shlex

    from kissgs._tables import bench_table
    from kissgs.bench import isolated_roundtrip
    from kissgs.evaluation.peers import measure_peer
    from kissgs.settings import Preset

    rows: list[tuple[str, str, Any]] = []
    all_settings = [_settings(name, None, None) for name in presets or list(Preset)]
    for scene in _expand(scenes):
        label = Path(scene).name
        for settings in all_settings:
            result = isolated_roundtrip(Path(scene), settings, threads=threads)
            rows.append((label, str(settings.preset), result))
        others = shlex.split(splat_transform)
        rows.extend((label, peer, measure_peer(Path(scene), peer, command=others)) for peer in peers or [])
    if as_json:
        _print_json([{"scene": scene, "encoder": name, **result.as_dict()} for scene, name, result in rows])
    else:
        _print(bench_table(rows))


@app.command()
def warmup() -> None:
    """Compile the encoder's kernels now, so that the first compression does not have to."""
    from kissgs.sogxt.encode import load_kernels

    with _progress(False) as progress:
        load_kernels(progress)


@app.callback(invoke_without_command=True)
def _version(version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False) -> None:
    if version:
        typer.echo(f"kissgs {__version__}")
        raise typer.Exit


def _settings(preset: str, changes: list[str] | None, seed: int | None) -> Settings:
    from kissgs.settings import Settings

    values: dict[str, Any] = {}
    for change in changes or []:
        name, equals, value = change.partition("=")
        if not equals:
            raise UnsupportedError(f"--set {change!r}: write NAME=VALUE, for example --set means_bits=16")
        values[name.strip()] = value.strip()
    if seed is not None:
        values["seed"] = seed
    return Settings.from_preset(preset, **values)


def _pairs(names: list[str], output: Path | None, suffix: str) -> Iterator[tuple[str, Path]]:
    """Every input with its output."""
    inputs = _expand(names)
    if len(inputs) > 1 and output is not None:
        if output.suffix.lower() in (".zip", ".ply") or str(output) == "-":
            raise OutputError(f"{len(inputs)} inputs cannot all become {output}; name a folder with -o")
        _make_folder(output)
        named = [output / (Path(name).stem + suffix) for name in inputs]
        if len(set(named)) < len(named):
            raise OutputError("two inputs have the same name and would become one file; compress them one by one")
        yield from zip(inputs, named, strict=True)
        return
    for name in inputs:
        if name == "-" and output is None:
            raise OutputError("standard input has no name; say where to write with -o")
        yield name, output or Path(name).with_suffix(suffix)


def _make_folder(folder: Path) -> None:
    from kissgs.io.atomic import reason_of

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot make the folder {folder}: {reason_of(error)}") from error


def _expand(names: list[str]) -> list[str]:
    """Patterns that the shell has not expanded, expanded."""
    found: list[str] = []
    for name in names:
        if not glob.has_magic(name) or Path(name).exists():
            found.append(name)
            continue
        matches = sorted(glob.glob(name))  # noqa: PTH207  Path.glob takes no absolute patterns
        if not matches:
            raise UnsupportedError(f"no file matches {name}")
        found.extend(matches)
    return found


def _progress(silent: bool) -> Any:  # noqa: ANN401
    from kissgs._console import progress_bar

    return progress_bar(silent)


def _print(what: RenderableType) -> None:
    from kissgs._console import output

    output().print(what)


def _print_json(reports: list[dict[str, Any]]) -> None:
    sys.stdout.write(json.dumps(reports[0] if len(reports) == 1 else reports, indent=2) + "\n")


def _fail(error: KissgsError) -> NoReturn:
    if "--json" in sys.argv:
        sys.stdout.write(json.dumps({"error": {"code": error.code, "message": str(error)}}) + "\n")
    sys.stderr.write(f"kissgs: {error}\n")
    sys.exit(2)
