"""The extremes are tested with the oracles and scenes of all stages."""

import sys
from pathlib import Path

TESTS = Path(__file__).parents[1]
sys.path += [str(TESTS / name) for name in ("sogxt", "rendering", "web")]
