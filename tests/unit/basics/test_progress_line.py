"""The line of slow work on the terminal."""

from __future__ import annotations

import io
import threading

import pytest
from deadlines import DEADLINE_S

from afspm.basics.progress_line import ProgressLine


class DrawnTerminal(io.StringIO):
    """A terminal that lets a test wait for a text."""

    def __init__(self) -> None:
        super().__init__()
        self.changed = threading.Condition()

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> int:
        with self.changed:
            self.changed.notify_all()
            return super().write(text)

    def wait_for(self, text: str) -> None:
        with self.changed:
            assert self.changed.wait_for(lambda: text in self.getvalue(), timeout=DEADLINE_S)


def test_line_shows_the_step_and_is_erased_around_other_text() -> None:
    terminal = DrawnTerminal()
    with ProgressLine("writing gwy", stream=terminal, after_s=0.0, every_s=0.0) as line:
        line.step("scan 3 of 26")
        terminal.wait_for("writing gwy · scan 3 of 26 · ")
        line.say("left out: scan 4")
    drawn = terminal.getvalue()
    assert "\rleft out: scan 4\n" in drawn
    assert drawn.rpartition("\n")[2].rpartition("\r")[2] == ""  # nothing is left on the terminal


@pytest.mark.parametrize("quiet", [False, True])
def test_nothing_is_drawn_if_quiet_or_without_a_terminal(quiet: bool) -> None:
    stream = DrawnTerminal() if quiet else io.StringIO()
    with ProgressLine("writing gwy", quiet=quiet, stream=stream, after_s=0.0) as line:
        assert "progress" not in {thread.name for thread in threading.enumerate()}
        line.say("left out: scan 4")
    assert stream.getvalue() == "left out: scan 4\n"
