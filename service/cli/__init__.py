"""The command ``kissgs-serve``."""
