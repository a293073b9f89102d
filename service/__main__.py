"""``python -m service`` is ``kissgs-serve``."""

from .cli.main import main

main()
