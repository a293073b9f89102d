"""Shared test helpers: scenes, reference implementations, a running service, a browser."""
