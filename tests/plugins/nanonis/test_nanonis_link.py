"""One connection to a controller with arbitrary or no answers."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Thread

import pytest
from deadlines import DEADLINE_S
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.plugins.vendor_bench import answering

from afspm.basics import Refused
from afspm.driver import ControllerLost
from afspm.model import ControlResponse
from afspm.plugins.nanonis.emulator import wire
from afspm.plugins.nanonis.parameter_groups import SafeTip
from afspm.plugins.nanonis.protocol import NanonisError
from afspm.plugins.nanonis.session import Link

GOOD = wire.reply("Bias.Get", wire.body("Bias.Get", [0.5], 0))


@contextmanager
def talking(*replies: bytes, silent: bool = False) -> Iterator[Link]:
    """Open a link to a server that answers each request with the next of some bytes, and may then disconnect."""
    with answering(*replies, silent=silent) as address:
        link = Link(address, 0.3 if silent else DEADLINE_S, time.monotonic)
        try:
            yield link
        finally:
            link.close()


def test_a_reply_in_many_parts_is_one() -> None:
    with talking(GOOD, GOOD) as link:
        assert link.ask("Bias.Get") == (0.5,)
        assert link.ask("Bias.Get") == (0.5,)


def test_an_error_of_the_controller_leaves_the_connection_as_it_is() -> None:
    refused = wire.reply("Bias.Set", wire.error_body("Bias.Set", "no", 0, bare=False))
    with talking(refused, GOOD) as link:
        with pytest.raises(NanonisError, match="no"):
            link.ask("Bias.Set", 1.0)
        assert link.ask("Bias.Get") == (0.5,)


# nanonis 37
def test_safe_tip_of_a_nanonis_without_one_is_not_supported() -> None:
    refused = wire.reply("SafeTip.OnOffGet", wire.error_body("SafeTip.OnOffGet", "not available", 0, bare=True))
    with talking(refused) as link, pytest.raises(Refused, match="not available") as found:
        SafeTip(link.ask).read()
    assert found.value.response == ControlResponse.PARAM_NOT_SUPPORTED


def test_answer_to_another_request_is_refused() -> None:
    # After it the connection is not trusted any more.
    late = wire.reply("Current.Get", wire.body("Current.Get", [0.5], 0))
    with talking(late, GOOD) as link:
        with pytest.raises(ControllerLost, match=r"replied to 'Current.Get' instead of Bias.Get"):
            link.ask("Bias.Get")
        with pytest.raises(ControllerLost, match="the connection was lost"):
            link.ask("Bias.Get")


@pytest.mark.parametrize("part", [0, 20, 40, 42, len(GOOD) - 1])
@pytest.mark.parametrize("silent", [False, True])
def test_truncated_reply_is_noticed_in_time(part: int, silent: bool) -> None:
    with (
        talking(GOOD[:part], silent=silent) as link,
        pytest.raises(ControllerLost, match="no answer to Bias.Get within" if silent else "closed after"),
    ):
        link.ask("Bias.Get")


def test_closing_wakes_a_waiting_thread() -> None:
    errors: list[Exception] = []
    with talking(b"", silent=True) as link:

        def wait() -> None:
            try:
                link.ask("Scan.WaitEndOfScan", -1, longer_s=1000.0)
            except ControllerLost as error:
                errors.append(error)

        waiting = Thread(target=wait)
        waiting.start()
        link.close()
        waiting.join(DEADLINE_S)
    assert len(errors) == 1


@given(st.binary(max_size=120), st.booleans())
@settings(max_examples=60)
def test_any_bytes_are_an_answer_or_a_named_error(content: bytes, headed: bool) -> None:
    reply = b"Bias.Get".ljust(32, b"\0") + struct.pack(">i", len(content)) + bytes(4) + content if headed else content
    with talking(reply) as link, suppress(ControllerLost, NanonisError):
        assert isinstance(link.ask("Bias.Get")[0], float)
