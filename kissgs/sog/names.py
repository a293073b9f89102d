"""Names of the metadata files of SOG containers and streamed scenes."""

META_NAME, LOD_NAME = "meta.json", "lod-meta.json"

MAX_METADATA_BYTES = 1 << 20
"""Largest size of ``meta.json``, bytes; four codebooks in full digits take 15 kB."""
