"""A part of the soak: after malformed messages scheduler, translator and component still serve, and have not grown."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from deadlines import DEADLINE_S


def test_five_thousand_malformed_messages_change_nothing() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.soak", "5000"],
        cwd=Path(__file__).parents[3],
        capture_output=True,
        encoding="utf-8",
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads(done.stdout.splitlines()[-1])["sent"] == 5_000
