"""The quality scale of drivers: answers agree with the rules and the tests, and the tool names each fault."""

from __future__ import annotations

import importlib
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
TOOL = ROOT / "tools" / "quality.py"
MAKERS = ["Asylum", "Gxsm", "Nanonis", "Nanosurf", "Park"]
REPORT = """
maker = "Acme"
driver = "my_scope.MyScope"
release = "3.1"
tried_on = "{tried_on}"
evidence = "`afspm commission`"
began = ""
afspm = "0.1.0"
format = 1
operations = {{ scan = "{outcome}" }}
"""


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("quality")


@pytest.fixture
def driver(tmp_path: Path) -> Path:
    """Return the folder of a driver in a package outside of this tree, without its answers."""
    (tmp_path / "pyproject.toml").touch()
    (tmp_path / "tests").mkdir()
    text = "def test_stop() -> None: ...\ndef helper() -> None: ...\nclass TestFrame:\n    def test_turned(self): ...\n"
    (tmp_path / "tests" / "test_my_scope.py").write_text(text, encoding="utf-8")
    folder = tmp_path / "my_scope"
    (folder / "reports").mkdir(parents=True)
    for kind, outcome in (("emulator", "passed"), ("instrument", "mismatch")):
        report = REPORT.format(tried_on=kind, outcome=outcome)
        (folder / "reports" / f"{kind}.toml").write_text(report, encoding="utf-8")
    return folder


def answer(tool: ModuleType, driver: Path, **given: str) -> list[str]:
    """Answer each rule with "todo" but for the given ones, whose text may be empty; return the faults."""
    lines = {name: f'{name} = "todo"' for name in tool.rules()} | {
        name.replace("_", "-"): text for name, text in given.items()
    }
    (driver / tool.FILE).write_text("\n".join(lines.values()), encoding="utf-8")
    faults: list[str] = tool.answers(driver)[1]
    return faults


def test_each_driver_of_a_controller_answers_every_rule(tool: ModuleType) -> None:
    assert list(tool.drivers()) == MAKERS
    assert [fault for folder in tool.drivers().values() for fault in tool.answers(folder)[1]] == []


def test_rules_have_names_of_their_own_and_a_sentence_each(tool: ModuleType) -> None:
    tables = tomllib.loads(tool.RULES.read_text(encoding="utf-8"))
    assert list(tables) == list(tool.LEVELS)
    assert len(tool.rules()) == sum(map(len, tables.values())) > 30
    assert [rule for rule in tool.rules().values() if not rule.says.endswith(".")] == []


def test_answers_with_tests_checks_and_reports_are_accepted(tool: ModuleType, driver: Path) -> None:
    faults = answer(
        tool,
        driver,
        panel_stop='panel-stop.done = ["tests/test_my_scope.py::test_stop"]',
        scan='scan.done = ["tests/test_my_scope.py::TestFrame::test_turned", "test-translator::scan/turned"]',
        live_lines='live-lines.exempt = "no command reads lines"',
        commissioned='commissioned.done = ["reports/emulator.toml", "tests/test_my_scope.py::test_stop"]',
    )
    assert faults == []


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ("", "scan: has no answer (A scan has exactly"),
        ('scan = "done"', "scan: 'done' is no answer; write `scan.done = "),
        ("scan.done = []", "is no answer"),
        ('scan.exempt = " "', "is no answer"),
        ('scan.exempt = "no"\nscan.done = ["tests/test_my_scope.py::test_stop"]', "is no answer"),
        ('scan = "todo"\nlive-line = "todo"', "live-line: no such rule; did you mean live-lines?"),
        ('scan.done = ["tests/test_my_scope.py::test_stops"]', "has no test 'test_stops'; did you mean test_stop?"),
        ('scan.done = ["tests/test_my_scope.py::helper"]', "has no test 'helper'"),
        ('scan.done = ["tests/test_my_scope.py::test_turned"]', "has no test 'test_turned'"),
        ('scan.done = ["tests/test_other.py::test_stop"]', "there is no file tests/test_other.py below"),
        ('scan.done = ["test-translator::scan/upside-down"]', "no check of `afspm test-translator`"),
        ('scan.done = ["reports/emulator.toml"]', "is a report, and this rule asks for tests"),
        ("scan =", "is not TOML"),
    ],
)
def test_wrong_answer_is_a_fault_with_a_remedy(tool: ModuleType, driver: Path, given: str, fault: str) -> None:
    faults = answer(tool, driver, scan=given)
    assert len(faults) == 1
    assert fault in faults[0]


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ('instrument.done = ["tests/test_my_scope.py::test_stop"]', "names no report tried on 'instrument'"),
        ('instrument.done = ["reports/emulator.toml"]', "was tried on 'emulator', not on 'instrument'"),
        ('instrument.done = ["reports/instrument.toml"]', "scan failed in reports/instrument.toml"),
        ('instrument.done = ["reports/none.toml"]', "reports/none.toml: is not a commissioning report"),
        ('instrument.exempt = "no time"', "no driver is exempt from platinum"),
    ],
)
def test_platinum_needs_the_report_of_an_instrument(tool: ModuleType, driver: Path, given: str, fault: str) -> None:
    (found,) = answer(tool, driver, instrument=given)
    assert fault in found


def test_level_is_reached_with_all_rules_of_it_and_below(tool: ModuleType) -> None:
    done, exempt, todo = tool.Answer(done=("x::y",)), tool.Answer(exempt="no command"), tool.Answer()
    given = {name: exempt if rule.level == "silver" else done for name, rule in tool.rules().items()}
    assert tool.reached(given) == list(tool.LEVELS)
    assert tool.reached(given | {"commissioned": todo}) == ["bronze", "silver"], "platinum does not count without gold"
    assert tool.answered(given | {"commissioned": todo}, "gold") == tool.answered(given, "gold") - 1
    assert tool.reached(given | {"scan": todo}) == []


def test_tool_names_the_file_of_a_fault_and_fails(tool: ModuleType, driver: Path) -> None:
    def compared() -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, TOOL, driver], capture_output=True, encoding="utf-8", check=False)

    missing = compared()
    assert missing.returncode == 1
    assert f"{driver / 'quality.toml'}: the driver has no quality.toml; copy" in missing.stderr
    answer(tool, driver)
    assert compared().returncode == 0
    (driver.parent / "pyproject.toml").unlink()
    answer(tool, driver, scan='scan.done = ["tests/test_my_scope.py::test_stop"]')
    assert "no folder above the driver has a pyproject.toml" in compared().stderr
