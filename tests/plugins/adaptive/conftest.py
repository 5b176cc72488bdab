"""Makes the repository's `benchmarks` importable: its generator of pairs serves the tests, too."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3]))
# the laboratory in memory that the client is tested with
sys.path.insert(0, str(Path(__file__).parents[2] / "unit" / "client"))
