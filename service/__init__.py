"""The HTTP service over the public API of kissgs."""
