"""``python -m service`` is ``kissgs-serve``."""

from service.cli import main

main()
