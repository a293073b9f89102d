"""``python -m kissgs`` is the command ``kissgs``."""

from kissgs.cli.main import main

if __name__ == "__main__":
    main()
