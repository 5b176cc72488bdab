"""The bridge in an experiment file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from afspm.basics import ConfigError
from afspm.experiment import load
from afspm.model import Role
from afspm_published.scheduler import PublishedScheduler

PEERS = """
[microscope]
component = true
class = "PublishedTranslator"
serve = "tcp://127.0.0.1:6666"
publish = "tcp://127.0.0.1:9000"

[scheduler]
component = true
class = "Scheduler"

[peers]
component = true
class = "PublishedPeers"
serve = "tcp://127.0.0.1:6667"
publish = "tcp://127.0.0.1:9001"
"""


def errors(folder: Path, text: str) -> list[str]:
    file = folder / "peers.toml"
    file.write_text(text, encoding="utf-8")
    return [f"{finding.what} {finding.hint}" for finding in load(file).check() if finding.is_error]


def test_peers_without_keys_need_consent(tmp_path: Path) -> None:
    (error,) = errors(tmp_path, PEERS)
    assert "[peers] lets programs without keys command the microscope" in error
    assert "[security] plain = true" in error
    assert errors(tmp_path, f"{PEERS}\n[security]\nplain = true\n") == []


def test_each_class_of_the_bridge_has_its_role(tmp_path: Path) -> None:
    file = tmp_path / "peers.toml"
    file.write_text(PEERS, encoding="utf-8")
    roles = {name: process.role for name, process in load(file).resolved.processes.items()}
    assert roles["microscope"] is Role.TRANSLATOR
    assert roles["peers"] is Role.COMPONENT


SCHEDULER = """
[scheduler]
component = true
class = "PublishedScheduler"
serve = "tcp://127.0.0.1:6667"
publish = "tcp://127.0.0.1:9001"

[security]
plain = true
"""
MICROSCOPE = """
[microscope]
component = true
class = "Simulator"
control_server = "tcp://127.0.0.1:6666"
publisher = "tcp://127.0.0.1:9000"
"""
AS_TRANSLATOR = """
[peers]
component = true
class = "PublishedPeers"
serve = "tcp://127.0.0.1:6666"
publish = "tcp://127.0.0.1:9000"
as_translator = true
"""


def test_a_published_scheduler_needs_no_microscope_in_the_file(tmp_path: Path) -> None:
    assert errors(tmp_path, SCHEDULER) == []


def test_a_microscope_beside_a_published_scheduler_is_refused(tmp_path: Path) -> None:
    (error,) = errors(tmp_path, SCHEDULER + MICROSCOPE)
    assert "[microscope] is never asked: [scheduler] passes all requests on" in error
    assert "from an experiment of its own, with Scheduler and PublishedPeers (as_translator = true)" in error
    assert "its own ports are encrypted" in error
    guide = Path(__file__).parents[3] / error.rpartition("see ")[2]
    assert guide.is_file()


@pytest.mark.parametrize("microscope", [MICROSCOPE.split("control_server")[0], ""], ids=["microscope", "none"])
def test_a_circle_through_a_published_scheduler_is_refused(tmp_path: Path, microscope: str) -> None:
    (error,) = errors(tmp_path, SCHEDULER + AS_TRANSLATOR + microscope)
    assert "[peers] acts as the microscope of the scheduler that [scheduler] asks: nothing is measured" in error
    assert errors(tmp_path, SCHEDULER + AS_TRANSLATOR.replace("as_translator = true", "")) == []


def test_simulated_time_under_a_published_scheduler_is_refused(tmp_path: Path) -> None:
    (error,) = errors(tmp_path, f"{SCHEDULER}[clock]\nspeed = 60.0\n")
    assert "[clock] speed = 60 on a microscope that is not simulated" in error


def test_a_published_scheduler_refuses_limits_that_it_would_not_enforce(tmp_path: Path) -> None:
    assert errors(tmp_path, SCHEDULER) == []

    def settings() -> dict[str, Any]:
        starts = load(tmp_path / "peers.toml").launches(take_address=lambda: "tcp://127.0.0.1:6668")
        return next(dict(start.launch.settings) for start in starts if start.role is Role.SCHEDULER)

    PublishedScheduler(**settings())
    assert errors(tmp_path, f"{SCHEDULER}\n[limits]\ntip-bias-voltage = {{ min = '-1 V', max = '1 V' }}\n") == []
    with pytest.raises(ConfigError, match="enforces no limits"):
        PublishedScheduler(**settings())
