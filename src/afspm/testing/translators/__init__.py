"""Conformance suite for translators: each operation of the wire format, checked from outside.

`afspm test-translator experiment.toml` starts translator and scheduler as real processes, or joins running ones, and
asks for everything that a component could ask for. The same as pytest items, one for each check:
`pytest -p afspm.testing.translators.plugin experiment.toml` (that plugin is loaded only where it is asked for).
"""

from __future__ import annotations

from afspm.testing.conformance import CheckOutcome, CheckResult
from afspm.testing.translators.report import CheckReport
from afspm.testing.translators.runner import run
from afspm.testing.translators.session import CheckOptions

__all__ = ["CheckOptions", "CheckOutcome", "CheckReport", "CheckResult", "run"]
