"""The extremes are tested with the codec's oracle and scenes."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "sogxt"))
