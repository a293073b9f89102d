"""Encoding-aware fine-tuning: the numbers in the images, improved against pictures of what a decoder makes of them."""
