"""Fitting Gaussians to pictures: what compaction and fine-tuning have in common."""
