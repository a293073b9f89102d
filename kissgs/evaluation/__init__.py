"""Evaluation: renderings of two scenes, and photographs, to metrics, JSON and HTML; its cameras are its own."""
