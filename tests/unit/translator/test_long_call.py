"""Commands that run until the instrument is done."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from afspm.driver import ControllerSilent, LongCall
from afspm.translator import long_call


class Silent:
    """A connection that has taken a command, and answers nothing."""

    def reply(self, what: str) -> tuple[bool, None]:
        return False, None

    def close(self) -> None: ...


def test_command_is_given_up_once_nothing_of_it_is_seen_for_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    # makers N1
    now_s, runs = [100.0], [False]
    monkeypatch.setattr(long_call, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    call = LongCall("force", Silent(), is_seen=lambda: runs[0])
    for now_s[0], runs[0] in ((109.0, False), (118.0, False), (200.0, True), (300.0, False), (309.0, False)):
        assert call.running()
    now_s[0] = 310.0
    with pytest.raises(ControllerSilent, match="the force has no answer, and has not run for 10 s"):
        call.running()
