"""The command line: one module per command; prints what the library returns."""
