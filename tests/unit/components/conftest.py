from __future__ import annotations

import sys
from pathlib import Path

# the laboratory in memory that the client is tested with
sys.path.insert(0, str(Path(__file__).parents[1] / "client"))
