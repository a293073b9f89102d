"""The SOG-XT container: nine lossless images and three metadata files. Takes an encoding plan; gives files, and back.
Needs no cameras and no renderer."""
