"""Conformance suite for translators, which checks each operation of the wire format from outside.

`afspm test-translator experiment.toml` starts translator and scheduler as real processes, or joins running ones, and
sends every request that a component could send. The same checks as pytest items:
`pytest -p afspm.testing.translators.plugin experiment.toml` (the plugin is loaded only on request).
"""

from __future__ import annotations

from afspm.testing.conformance import CheckOutcome, CheckResult
from afspm.testing.translators.report import CheckReport
from afspm.testing.translators.runner import run
from afspm.testing.translators.session import CheckOptions

__all__ = ["CheckOptions", "CheckOutcome", "CheckReport", "CheckResult", "run"]
