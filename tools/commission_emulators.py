"""Writes the reports of the emulated controllers, for the matrix: `python tools/commission_emulators.py [DRIVER…]`.

It goes through `afspm commission` with each, at the speed that the command has by itself.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from afspm.basics import entry_points
from afspm.testing.commissioning.procedure import REHEARSAL_PATIENCE, commission
from afspm.testing.commissioning.report import InstrumentReport
from afspm.testing.translators import CheckOptions

ROOT = Path(__file__).resolve().parents[1]


class NoPanel:
    """Confirms all, and sees nothing."""

    def show(self, text: str) -> None:
        sys.stdout.write(f"{text}\n")

    def confirm(self, question: str) -> bool:
        return True

    def text(self, question: str) -> str:
        return ""

    def choose(self, question: str, options: Sequence[str], default: str = "") -> str:
        return default


def main(names: Sequence[str]) -> None:
    for name in names or entry_points.names(entry_points.DRIVERS):
        folder = entry_points.folder(entry_points.DRIVERS, name)
        if folder is None or not (folder / "emulated.toml").exists():
            continue
        file = folder / "reports/emulator.toml"
        runs = ROOT / "build/commissioning"
        options = CheckOptions([folder / "emulated.toml"], runs=runs, patience=REHEARSAL_PATIENCE)
        result = commission(options, NoPanel(), file, "emulator")
        sys.stdout.write(f"{name}: {'passed' if result.passed else 'NOT AS IT SHOULD BE'} {result.lost}\n")
        report = InstrumentReport.read(file)
        replace(report, evidence="`afspm commission`, without a panel").write(file)


if __name__ == "__main__":
    main(sys.argv[1:])
