"""The stages put together: compact, compress and decompress, rate control, reports."""
