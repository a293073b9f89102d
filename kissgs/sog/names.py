"""Name of the metadata file of SOG containers."""

META_NAME = "meta.json"

MAX_METADATA_BYTES = 1 << 20
"""Largest size of ``meta.json``, bytes; four codebooks in full digits take 15 kB."""
