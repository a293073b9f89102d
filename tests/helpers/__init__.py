"""What several test modules share: scenes, reference implementations, a running service, a browser."""
