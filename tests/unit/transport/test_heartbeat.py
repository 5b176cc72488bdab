"""Heartbeats of idle and busy processes."""

from __future__ import annotations

import time
from typing import Any

import pytest
from deadlines import DEADLINE_S

from afspm.transport.heartbeat import Heartbeat, HeartbeatListener, HeartbeatSender, read_beat
from afspm.transport.polling import WakeUp


def beats(listener: HeartbeatListener, count: int, timeout_s: float = DEADLINE_S) -> list[Heartbeat]:
    found: list[Heartbeat] = []
    deadline_s = time.monotonic() + timeout_s
    while len(found) < count:
        assert time.monotonic() < deadline_s, "no beats"
        found += listener.poll(0.1)
    return found


def test_the_first_beat_comes_at_once_and_others_follow_with_the_age_of_the_step(open_: Any) -> None:
    listener = open_(HeartbeatListener())
    address = listener.listen("Component")[0]
    sender = open_(HeartbeatSender(address, 1e9, lambda: 1.5, lambda: 30.0))
    assert beats(listener, 1) == [Heartbeat("Component", False, 1.5, 30.0)]
    sender.close()
    assert beats(listener, 1)[-1] == Heartbeat("Component", True, 1.5, 30.0)


def test_heartbeats_keep_their_period_while_the_main_thread_is_busy(open_: Any) -> None:
    listener = open_(HeartbeatListener())
    open_(HeartbeatSender(listener.listen("Component")[0], 0.02, lambda: 0.0, lambda: 30.0))
    assert len(beats(listener, 5)) >= 5


def test_heartbeats_arrive_under_the_name_of_their_process(open_: Any) -> None:
    listener = open_(HeartbeatListener())
    for name in ("One", "Two"):
        open_(HeartbeatSender(listener.listen(name)[0], 0.02, lambda: 0.0, lambda: 30.0))
    names: set[str] = set()
    deadline_s = time.monotonic() + DEADLINE_S
    while names != {"One", "Two"}:
        assert time.monotonic() < deadline_s
        names |= {beat.name for beat in listener.poll(0.1)}


@pytest.mark.parametrize("needs_token", [True, False])
def test_only_the_process_itself_can_send_its_heartbeats(open_: Any, needs_token: bool) -> None:
    """A token identifies the process, from the beginning or from its first heartbeat on."""
    listener = open_(HeartbeatListener())
    address = listener.listen("Component", token="secret", needs_token=needs_token)[0]
    sender = open_(HeartbeatSender(address, 0.02, lambda: 0.0, lambda: 30.0, "secret"))
    found = beats(listener, 1)
    for token in ("", "guess"):  # each says at its end that it closes
        stranger = open_(HeartbeatSender(address, 0.005, lambda: 7.0, lambda: 30.0, token))
        deadline_s = time.monotonic() + DEADLINE_S
        while not stranger.heard.is_set():
            assert time.monotonic() < deadline_s
            found += listener.poll(0.01)
        stranger.close()
        found += beats(listener, 10)
    assert all(not beat.closing and beat.step_age_s == 0.0 for beat in found)
    sender.close()
    assert beats(listener, 1)[-1].closing


def test_heartbeats_of_version_1_need_no_token(open_: Any) -> None:
    listener = open_(HeartbeatListener())
    open_(HeartbeatSender(listener.listen("Component", token="secret")[0], 0.02, lambda: 0.0, lambda: 30.0))
    assert not beats(listener, 2)[-1].closing


def test_waiting_for_beats_ends_when_woken_up(open_: Any) -> None:
    wake_up: WakeUp[str] = open_(WakeUp())
    listener = open_(HeartbeatListener())
    listener.end_polls_by(wake_up.fileno())
    listener.listen("Component")
    wake_up.post("signal")
    assert listener.poll(None) == []
    assert wake_up.take() == ["signal"]


@pytest.mark.parametrize(
    ("frames", "beat"),
    [
        ([b"\0"], Heartbeat("C", False)),
        ([b"\1"], Heartbeat("C", True)),
        ([b"\0", b"2.5"], Heartbeat("C", False, 2.5)),
        ([b"\0", b"nan", b"-1"], Heartbeat("C", False)),
        ([b"\0", b"x", b"3"], Heartbeat("C", False, None, 3.0)),
        ([b"\2"], None),
        ([b""], None),
        ([], None),
    ],
)
def test_heartbeats_of_both_versions_are_read_and_other_messages_ignored(
    frames: list[bytes], beat: Heartbeat | None
) -> None:
    assert read_beat("C", frames) == beat
