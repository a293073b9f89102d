"""The SOG-XT codec: Gaussians as nine lossless images and a small metadata file. Needs no camera and no renderer."""
