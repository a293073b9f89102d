"""Training, common to compaction and fine-tuning: a scene and views -> supervision views, target images, training loop.
The loop fits any :class:`kissgs.training.loop.TrainableScene`; checkpoints make long work resumable."""
