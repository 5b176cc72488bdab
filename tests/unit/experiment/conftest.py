"""Experiment files for tests, with a module of components beside them."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from afspm.experiment import Experiment, Finding, load

COMPONENTS = """
from __future__ import annotations

from enum import Enum
from pathlib import Path

from afspm.basics.addresses import ListeningAddress
from afspm.translator.driver import Driver
from afspm.client.component import Component
from afspm.basics.units import Angle, Duration, Length, Voltage


class Style(Enum):
    QUICK = "quick"
    SLOW = "slow"


class Scanner(Component):
    listens = ("Scan2d", "ControlState")

    def __init__(self, size: tuple[Length, Length], every: Duration = 60.0, angle: Angle = 0.0, count: int = 3,
                 style: Style = Style.QUICK, image: Path | None = None, names: list[str] | None = None): ...


class Alternatives(Component):
    def __init__(self, either: int | str = 1, span: Length | tuple[Length, Length] = 0.0): ...


class Classifier(Component):
    flags = ("tip-shape-changed",)
    listens = ("Scan2d",)


class Corrector(Component):
    solves = ("tip-shape-changed",)

    def __init__(self, voltage: Voltage = 3.0): ...


class Listener(Component):
    def __init__(self, at: ListeningAddress = "tcp://127.0.0.1:9010"): ...


class Peaks(Component):
    publishes = ("PeakList",)
    listens = ("Scan2d",)


class Chooser(Component):
    listens = ("PeakList",)


class Anything(Component):
    def __init__(self, **settings): ...


class Plan:
    def __init__(self, size: Length, rounds: int = 1):
        self.size, self.rounds = size, rounds


def mute(header):
    return f"mine/{header.message}"


def narrow(header):
    return f"{header.message}_{header.size_m[0]}"


def wide(header):
    return header.message if header.size_m is None else f"{header.message}_{header.size_m[0]}"


class Planner(Component):
    def __init__(self, plan: Plan, more: list[Plan] | None = None):
        self.plan, self.more = plan, more


class Derived(Scanner):
    def __init__(self, extra: int = 0, **settings):
        super().__init__(**settings)


class Simulated(Driver):
    simulated = True


class Real(Driver):
    pass


class Emulated:
    emulated = True
    listens = ()

    def __init__(self, port: int = 0): ...

    def run_process(self, context): ...


class Swapper(Component):
    needs_actions = ("x-swap-mode", "x-pulse")
    needs_parameters = ("x-drive",)


class Untyped(Component):
    def __init__(self, size=1e-6, label="", typed: str = ""):
        self.size, self.label, self.typed = size, label, typed


class NoComponent:
    pass
"""

PYTHON = json.dumps(sys.executable)
"""The one program that is on every computer; texts say "python3" for it."""

# commands, so that these tests depend on the file and not on classes
FRAME = f"""
[scheduler]
component = true
role = "scheduler"
command = [{PYTHON}]

[microscope]
component = true
role = "translator"
command = [{PYTHON}]
simulated = true
"""

Write = Callable[..., Experiment]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Write an experiment file (with scheduler and translator, unless `frame` is empty) and load it."""
    (tmp_path / "parts.py").write_text(COMPONENTS, encoding="utf-8")

    def write(text: str, *overlays: str, frame: str = FRAME) -> Experiment:
        files = []
        for i, content in enumerate([(text + frame).replace('"python3"', PYTHON), *overlays]):
            file = tmp_path / ("night.toml" if i == 0 else f"over{i}.toml")
            file.write_text(content, encoding="utf-8")
            files.append(file)
        return load(*files)

    return write


def line_of(experiment: Experiment, start: str, file: str = "night.toml") -> int:
    """Return the number (from 1) of the line that begins with `start`."""
    lines = (experiment.folder / file).read_text(encoding="utf-8").splitlines()
    return next(i for i, line in enumerate(lines, 1) if line.startswith(start))


def errors(experiment: Experiment) -> list[Finding]:
    return [finding for finding in experiment.check() if finding.is_error]


def only_error(experiment: Experiment) -> Finding:
    found = errors(experiment)
    assert len(found) == 1, "\n".join(map(str, found)) or "no error was found"
    return found[0]
