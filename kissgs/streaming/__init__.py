"""Streaming: a scene of any size -> a folder of chunks and levels of detail, within bounded memory. The scene is read
in blocks and split into chunks in a scratch folder; each chunk is merged into coarser levels; every file is encoded by
itself. The manifest names, for each leaf of a tree over space, its rows in the files of every level."""
