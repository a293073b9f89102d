"""``kissgs sample``: write a synthetic scene for tests and demos."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kissgs.cli.options import ForceOption


def sample(
    output: Annotated[Path, typer.Argument(help="Output NAME.ply; other formats as for convert.")],
    gaussians: Annotated[int, typer.Option(min=0, help="Number of Gaussians.")] = 60_000,
    degree: Annotated[int, typer.Option(min=0, max=3, help="Degree of the spherical harmonics.")] = 3,
    force: ForceOption = False,
) -> None:
    """Write a synthetic sample scene: shiny, textured objects on a table."""
    from kissgs.pipeline.scene_files import save
    from kissgs.synthetic import sample_scene

    save(sample_scene(gaussians, sh_degree=degree), output, overwrite=force)
