"""The launch line of a process."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.basics.errors import ConfigError
from afspm.basics.exit_codes import ExitCode
from afspm.basics.launch import Launch, Sockets
from afspm.supervisor.supervision.child import ChildPolicy

FULL = Launch(
    name="tip classifier",
    class_="my.lab.Classifier",
    settings={"threshold": 0.5, "channels": ["Höhe"], "model": {"path": "x"}, "none": None},
    sockets=Sockets(publish="tcp://127.0.0.1:1", subscribe=("a", "b"), control="c", heartbeat="d"),
    envelopes=("Scan2d", "ControlState"),
    clock={"origin_s": 1.0, "start_s": 2.0, "speed": 1000.0},
    problems={"water-film": 7},
    keys={"folder": "keys"},
    messages=("my.messages_pb2",),
    simulated=True,
)


def test_a_launch_comes_back_as_it_was() -> None:
    assert Launch.from_json(FULL.to_json()) == FULL
    assert "\n" not in FULL.to_json()


def test_missing_entries_have_their_defaults() -> None:
    assert Launch.from_json('{"name": "x"}') == Launch("x")


@given(st.text(max_size=50))
def test_text_without_a_launch_line_is_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        Launch.from_json(text)


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ("nam", "x"), ("settings", []), ("beat_period_s", "1"), ("beat_period_s", -1), ("request_retries", True),
        ("sockets", "tcp"), ("sockets", {"bind": "x"}), ("sockets", {"publish": 5}), ("envelopes", [1]),
        ("class", 5), ("problems", None), ("name", ""),
    ],
)  # fmt: skip
def test_invalid_entry_is_refused_by_name(entry: str, value: object) -> None:
    with pytest.raises(ConfigError, match=entry.rstrip("s")):
        Launch.from_json(json.dumps({"name": "x", entry: value}))


def test_misspelt_entry_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ConfigError, match="did you mean 'settings'"):
        Launch.from_json('{"name": "x", "setings": {}}')


def test_only_exits_on_purpose_prevent_a_restart() -> None:
    assert set(ChildPolicy().final_codes) == set(ExitCode) - {ExitCode.CRASHED, ExitCode.OWN_FAULT, ExitCode.ORPHAN}
