"""``kissgs sample``: a scene to try things on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kissgs.cli.arguments import (
    ForceOption,
)


def sample(
    output: Annotated[Path, typer.Argument(help="The .ply to write.")],
    gaussians: Annotated[int, typer.Option(min=0, help="How many.")] = 60_000,
    degree: Annotated[int, typer.Option(min=0, max=3, help="Of its spherical harmonics.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Another seed makes another scene.")] = 0,
    force: ForceOption = False,
) -> None:
    """Make a sample scene: glossy, textured things on a table."""
    from kissgs.pipeline.scene_files import save
    from kissgs.synthetic.scene import sample_scene

    save(sample_scene(gaussians, sh_degree=degree, seed=seed), output, overwrite=force)
