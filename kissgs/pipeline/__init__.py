"""The composition of all stages: compact, compress and decompress, searches for goals, reports."""
