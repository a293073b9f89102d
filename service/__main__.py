"""``python -m service`` is ``kissgs-serve``."""

from service.cli.main import main

main()
