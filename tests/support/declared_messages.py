"""Messages that a test declares."""

from __future__ import annotations

import pytest

from afspm.wire import messages


def forget_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget the messages that are declared from now on at the end of the test."""
    monkeypatch.setattr(messages, "_declared", dict(messages._declared))
