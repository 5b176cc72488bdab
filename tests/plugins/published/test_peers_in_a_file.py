"""The bridge in an experiment file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from afspm.basics.errors import ConfigError
from afspm.experiment import load
from afspm.model import Role
from afspm.plugins.published.scheduler import PublishedScheduler

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


def test_a_published_scheduler_refuses_limits_that_it_would_not_enforce(tmp_path: Path) -> None:
    text = """
[microscope]
component = true
class = "Simulator"

[scheduler]
component = true
class = "PublishedScheduler"
serve = "tcp://127.0.0.1:6667"
publish = "tcp://127.0.0.1:9001"
"""
    assert errors(tmp_path, text) == []

    def settings() -> dict[str, Any]:
        starts = load(tmp_path / "peers.toml").launches(take_address=lambda: "tcp://127.0.0.1:6668")
        return next(dict(start.launch.settings) for start in starts if start.role is Role.SCHEDULER)

    PublishedScheduler(**settings())
    assert errors(tmp_path, f"{text}\n[limits]\ntip-bias-voltage = {{ min = '-1 V', max = '1 V' }}\n") == []
    with pytest.raises(ConfigError, match="enforces no limits"):
        PublishedScheduler(**settings())
