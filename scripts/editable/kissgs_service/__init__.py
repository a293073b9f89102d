"""The folder ``service`` under the name that it has in a wheel; only an installation with ``--editable`` uses this."""

from pathlib import Path

__path__ = [str(Path(__file__).parents[3] / "service")]
