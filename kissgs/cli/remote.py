"""``kissgs remote``: compression by a service elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from kissgs.cli.files import each, print_json, show

ServerOption = Annotated[
    str, typer.Option("--server", envvar="KISSGS_SERVER", metavar="URL", help="Address of the service.")
]
KeyOption = Annotated[
    str | None, typer.Option("--key", envvar="KISSGS_KEY", help="Where it asks for one; better set KISSGS_KEY.")
]

DEFAULT_SERVER = "http://127.0.0.1:8000"

app = typer.Typer(name="remote", help="Let a kissgs service do the work.", no_args_is_help=True)


@app.command()
def compress(
    scenes: Annotated[list[str], typer.Argument(metavar="FILE…", help="Files or patterns.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="NAME.zip, or a folder; by default beside the scene.")
    ] = None,
    server: ServerOption = DEFAULT_SERVER,
    key: KeyOption = None,
    preset: Annotated[str, typer.Option("--preset", "-p", help="fast, balanced, small or paper.")] = "balanced",
    changes: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Change one setting of the preset.")
    ] = None,
    psnr: Annotated[
        float | None, typer.Option(metavar="DB", help="The smallest container with this PSNR to the scene's pictures.")
    ] = None,
    target_size: Annotated[
        str | None, typer.Option(metavar="SIZE", help="The best container of at most this size: 800kB, 2.5MB.")
    ] = None,
    max_psnr_drop: Annotated[
        float | None, typer.Option(metavar="DB", help="The smallest container whose pictures lose no more: 0.1.")
    ] = None,
    compact: Annotated[
        str | None,
        typer.Option(metavar="BUDGET", help="Fewer Gaussians first: 200k, 20% or 0.2dB; auto: as the goal needs."),
    ] = None,
    finetune: Annotated[
        str | None, typer.Option(metavar="[STEPS]", help="Then fit the numbers in the images to pictures of the scene.")
    ] = None,
    evaluate: Annotated[bool, typer.Option("--evaluate", help="Measure PSNR and SSIM of the result.")] = False,
    force: Annotated[bool, typer.Option("--force", "-f", help="Overwrite files that exist.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print what the service reports as JSON.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
) -> None:
    """Compress scenes on a server. Ctrl-C cancels the job there."""
    from kissgs.cli.console import progress_bar
    from kissgs.cli.options import budget_of, chosen
    from kissgs.client.remote import Remote
    from kissgs.core.errors import UnsupportedError

    if "-" in scenes or str(output) == "-":
        raise UnsupportedError("remote compression reads and writes files; name them")
    settings = chosen(
        preset,
        changes,
        budget=None if compact is None else budget_of(compact),
        finetune=finetune,
        psnr=psnr,
        target_size=target_size,
        max_psnr_drop=max_psnr_drop,
    )
    with Remote(server, key=key) as remote:

        def work(scene: str, target: Path) -> dict[str, Any]:
            with progress_bar(quiet or as_json) as progress:
                status = remote.compress(
                    scene, target, settings=settings, evaluate=evaluate, overwrite=force, progress=progress
                )
            if not (quiet or as_json):
                show(_summary(status, target))
            return status

        each(scenes, output, ".zip", as_json, work)


@app.command(name="list")
def list_jobs(
    server: ServerOption = DEFAULT_SERVER,
    key: KeyOption = None,
    limit: Annotated[int, typer.Option(min=1, max=100, help="How many.")] = 20,
    as_json: Annotated[bool, typer.Option("--json", help="Print what the service reports as JSON.")] = False,
) -> None:
    """Show the latest jobs on a server."""
    from kissgs.client.remote import Remote

    with Remote(server, key=key) as remote:
        jobs = remote.jobs(limit)
    if as_json:
        print_json(jobs)
        return
    for job in jobs:
        ratio = f"{job['sizes']['ratio']:6.1f}x" if "sizes" in job else " " * 7
        show(f"{job['id']}  {job['state']:9}  {ratio}  {job['timings']['created_at'][:19]}  {job['name']}")


@app.command()
def get(
    job: Annotated[str, typer.Argument(help="Its id, see 'list'.")],
    output: Annotated[Path | None, typer.Option("--output", "-o", help="NAME.zip; by default the scene's.")] = None,
    server: ServerOption = DEFAULT_SERVER,
    key: KeyOption = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Overwrite a file that exists.")] = False,
) -> None:
    """Wait for a job, and download its container."""
    from kissgs.cli.console import progress_bar
    from kissgs.client.remote import Remote
    from kissgs.io.atomic import refuse_existing

    with Remote(server, key=key) as remote, progress_bar(False) as progress:
        target = output or Path(f"{remote.status(job)['name']}.zip")
        refuse_existing(target, overwrite=force)
        status = remote.follow(job, progress)
        remote.download(status, target, overwrite=force, progress=progress)
    show(_summary(status, target))


@app.command()
def cancel(
    job: Annotated[str, typer.Argument(help="Its id, see 'list'.")],
    server: ServerOption = DEFAULT_SERVER,
    key: KeyOption = None,
) -> None:
    """Stop a job."""
    from kissgs.client.remote import Remote

    with Remote(server, key=key) as remote:
        show(f"{job} {remote.cancel(job)['state']}")


def _summary(status: dict[str, Any], target: Path) -> str:
    sizes, evaluation = status["sizes"], status.get("evaluation")
    text = (
        f"{target}  {status['upload_bytes']:,} → {sizes['container']:,} bytes, {sizes['ratio']:.1f} times smaller, "
        f"{sizes['bytes_per_gaussian']:.2f} per Gaussian, {status['timings']['run_seconds']:.1f} s"
    )
    if evaluation is None:
        return text
    psnr = "∞" if evaluation.get("psnr") is None else f"{evaluation['psnr']:.2f}"
    return f"{text}, PSNR {psnr}, SSIM {evaluation['ssim']:.4f}"
