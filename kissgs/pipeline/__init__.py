"""The composition of all stages: compact, compress and decompress, rate control, reports."""
