"""The command line, which prints what the library returns."""
