"""The folder with files of real microscopes, which are under many licences and so not in the repository.

The environment variable AFSPM_DATA names it. Default: `shared/data`, beside the folder of the clone.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

DATA: Final = Path(os.environ.get("AFSPM_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
