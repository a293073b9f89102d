"""A kissgs service elsewhere, used from Python."""
