"""Forwarded requests: one is in flight, each is answered, and late answers find their request."""

from __future__ import annotations

from dataclasses import replace

import pytest
from tests.unit.scheduler.core_parts import Held

from afspm.model import ControlResponse, Request, Response, ResponseDetail
from afspm.model.idempotency_cache import IdempotencyCache, RequestStatus
from afspm.scheduler.requests.forwarder import ForwardedRequest, Forwarder, ForwardOutcome, SettledRequest

OK = Response(int(ControlResponse.SUCCESS))


def job(client: str, id_: str = "", command: bool = True) -> ForwardedRequest:
    return ForwardedRequest(client, Request(1, "start-scan", b"x", id_), command)


def sends(forwarder: Held[Forwarder], now_s: float) -> list[int]:
    """Send as `request_pipeline.send_next` does, with every request allowed."""
    while forwarder.is_free and (waiting := (*forwarder.own, *forwarder.queue)):
        forwarder.sent(waiting[0], now_s)
    return sent(forwarder)


def sent(forwarder: Held[Forwarder]) -> list[int]:
    numbers = [forward.number for forward in forwarder.outbox]
    forwarder.part = replace(forwarder.part, outbox=())
    return numbers


def up(**settings: float) -> Held[Forwarder]:
    forwarder = Held(Forwarder(**settings))  # type: ignore[arg-type]
    forwarder.connected()
    return forwarder


def test_one_request_is_in_flight_and_the_others_wait() -> None:
    forwarder = up()
    for name in "abc":
        assert forwarder.ask(job(name), 0.0) is None
    assert sends(forwarder, 0.0) == [1]
    settled = forwarder.answered(1, OK)
    assert settled is not None
    assert (settled.job.client, settled.end, sends(forwarder, 0.1)) == ("a", ForwardOutcome.ANSWERED, [2])


def test_without_a_translator_every_request_is_answered_at_once() -> None:
    refused = Held(Forwarder()).ask(job("a"), 0.0)
    assert refused is not None
    assert (refused.end, refused.response.code) == (ForwardOutcome.NOT_SENT, ControlResponse.NO_RESPONSE)
    assert refused.response.detail is ResponseDetail.NOT_SENT


def test_loss_separates_unknown_outcomes_from_unsent_requests() -> None:
    forwarder = up()
    forwarder.ask(job("a"), 0.0)
    forwarder.ask(job("b"), 0.0)
    sends(forwarder, 0.0)
    ends = {settled.job.client: settled for settled in forwarder.lost()}
    assert ends["a"].end is ForwardOutcome.UNKNOWN
    assert ends["a"].response.detail is ResponseDetail.OUTCOME_UNKNOWN
    assert ends["b"].end is ForwardOutcome.NOT_SENT


def test_every_request_is_answered_after_its_timeout() -> None:
    forwarder = up(timeout_s=5.0, patience_s=5.0)
    forwarder.ask(job("a"), 0.0)
    assert sends(forwarder, 0.0) == [1]
    forwarder.ask(job("b"), 1.0)
    assert forwarder.deadline_s() == 5.0
    assert [(s.job.client, s.end) for s in forwarder.expired(5.0)] == [("a", ForwardOutcome.UNKNOWN)]
    assert [(s.job.client, s.end) for s in forwarder.expired(6.0)] == [("b", ForwardOutcome.NOT_SENT)]
    assert sends(forwarder, 6.0) == []


def test_a_late_answer_is_never_another_s() -> None:
    forwarder = up(timeout_s=5.0, patience_s=5.0)
    forwarder.ask(job("a"), 0.0)
    assert sends(forwarder, 0.0) == [1]
    forwarder.expired(5.0)
    forwarder.ask(job("b"), 6.0)
    assert sends(forwarder, 6.0) == []
    forwarder.expired(10.0)
    assert sends(forwarder, 10.0) == [2]
    late = forwarder.answered(1, OK)
    assert late is not None
    assert (late.job.client, late.end) == ("a", ForwardOutcome.LATE)
    assert forwarder.flight is not None
    assert forwarder.flight.client == "b"
    assert forwarder.answered(1, OK) is None
    assert forwarder.answered(999, OK) is None


def test_an_overdue_request_that_is_repeated_is_waited_for_again() -> None:
    forwarder = up(timeout_s=5.0, patience_s=5.0)
    forwarder.ask(job("a", "k"), 0.0)
    sends(forwarder, 0.0)
    forwarder.expired(5.0)
    again = forwarder.part.asked_again("a", "k", 5.5)
    assert again is not None
    forwarder.part = again
    settled = forwarder.answered(1, OK)
    assert settled is not None
    assert settled.end is ForwardOutcome.ANSWERED


def test_endless_retries_do_not_block_the_line() -> None:
    forwarder = up(timeout_s=5.0, patience_s=5.0)
    forwarder.ask(job("a", "k"), 0.0)
    assert sends(forwarder, 0.0) == [1]
    forwarder.expired(5.0)
    again = forwarder.part.asked_again("a", "k", 9.9)
    assert again is not None
    forwarder.part = again
    forwarder.ask(job("b"), 11.0)
    assert [s.job.client for s in forwarder.expired(14.9)] == ["a"]
    assert forwarder.asked_again("a", "k", 15.0) is None
    assert sends(forwarder, 15.0) == [2]


def test_requests_of_the_scheduler_go_first() -> None:
    forwarder = up()
    forwarder.ask(job("a"), 0.0)
    forwarder.ask(job("b"), 0.0)
    sends(forwarder, 0.0)
    own = forwarder.ask_own(Request(1, "stop-scan"), 0.0)
    forwarder.answered(1, OK)
    assert own is not None
    assert sends(forwarder, 0.1) == [own.number]


def test_the_queue_is_bounded() -> None:
    forwarder = up(longest_queue=3)
    results = [forwarder.ask(job(str(n), command=False), 0.0) for n in range(10)]
    refused = [result for result in results if isinstance(result, SettledRequest)]
    assert len(refused) == 7
    assert all(r.response.detail is ResponseDetail.NOT_SENT for r in refused)


def test_waiting_requests_can_be_called_back_and_sent_ones_not() -> None:
    forwarder = up()
    for name in ("a", "a", "b"):
        forwarder.ask(job(name), 0.0)
    sends(forwarder, 0.0)
    assert [j.number for j in forwarder.called_back(lambda j: j.client == "a")] == [2]
    assert forwarder.flight is not None


def test_a_repeated_id_has_the_fate_of_the_first() -> None:
    once = Held(IdempotencyCache())
    request = Request(1, "start-scan", b"x", "exp/a/1")
    assert once.look_up("exp", request) is None
    once.noted("exp", request, RequestStatus.PENDING)
    assert once.look_up("exp", request) is RequestStatus.PENDING
    once.noted("exp", request, OK)
    assert once.look_up("exp", request) is OK
    assert once.look_up("other", request) is None
    once.forgotten("exp", request)
    assert once.look_up("exp", request) is None


def test_an_id_used_for_another_request_is_refused() -> None:
    once = Held(IdempotencyCache())
    once.noted("exp", Request(1, "start-scan", b"x", "key"), OK)
    other = once.look_up("exp", Request(1, "x-pulse", b"y", "key"))
    assert isinstance(other, Response)
    assert other.code == ControlResponse.FAILURE


def test_the_table_is_bounded_and_forgets_the_oldest() -> None:
    once = Held(IdempotencyCache(per_client=5, clients=3))
    for n in range(100):
        once.noted("exp", Request(1, id=str(n)), OK)
        once.noted(f"other-{n}", Request(1, id="1"), OK)
    assert once.look_up("exp", Request(1, id="99")) is OK
    assert once.look_up("exp", Request(1, id="94")) is None
    assert once.look_up("other-50", Request(1, id="1")) is None


def numbered(n: int) -> Request:
    return Request(1, "x-pulse", b"p", f"exp/a/{n}")


def test_forgotten_id_is_never_new_again() -> None:
    once = Held(IdempotencyCache())
    for n in range(1, 400):
        once.noted("exp", numbered(n), OK)
    assert once.look_up("exp", numbered(1)) is RequestStatus.FORGOTTEN
    assert once.look_up("exp", numbered(399)) is OK
    assert once.look_up("exp", numbered(400)) is None
    assert once.look_up("exp", Request(1, id="exp/b/1")) is None  # another life of it


def test_ids_of_a_forgotten_client_are_not_new() -> None:
    once = Held(IdempotencyCache(clients=3))
    once.noted("exp", numbered(7), OK)
    for n in range(10):
        once.noted(f"other-{n}", Request(1, id=f"other-{n}/a/1"), OK)
    assert once.look_up("exp", numbered(7)) is RequestStatus.FORGOTTEN
    assert once.look_up("exp", numbered(8)) is None


@pytest.mark.parametrize("id_", ["exp/key/tile-17/0", "exp/a/17/0", "pulse-1", "exp/key/5"])
def test_unnumbered_id_is_not_displaced_by_numbered_ones(id_: str) -> None:
    once = Held(IdempotencyCache())
    once.noted("exp", Request(1, id=id_), OK)
    for n in range(1, 400):
        once.noted("exp", numbered(n), OK)
    assert once.look_up("exp", Request(1, id=id_)) is OK


def test_forgotten_ids_are_known_after_a_restart() -> None:
    before = Held(IdempotencyCache())
    for n in range(1, 400):
        before.sent("exp", numbered(n))
    after = IdempotencyCache().restored(before.sent_actions, before.floors.numbers)
    assert after.look_up("exp", numbered(1)) is RequestStatus.FORGOTTEN
    assert after.look_up("exp", numbered(399)) is RequestStatus.UNKNOWN
    assert after.look_up("exp", numbered(400)) is None


def test_clients_take_turns_and_commands_go_before_the_reads_of_others() -> None:
    # faults A2
    forwarder = up()
    for n in range(5):
        forwarder.ask(job("flooder", f"f{n}", command=False), 0.0)
    assert sends(forwarder, 0.0) == [1]
    forwarder.ask(job("reader", "r0", command=False), 0.0)
    forwarder.ask(job("reader", "r1", command=False), 0.0)
    forwarder.ask(job("holder", "h0"), 0.0)
    forwarder.ask(job("holder", "h1", command=False), 0.0)
    forwarder.ask(job("holder", "h2"), 0.0)
    ids = [waiting.request.id for waiting in forwarder.queue]
    assert ids == ["h0", "f1", "r0", "f2", "r1", "h1", "h2", "f3", "f4"]


def test_flooding_client_keeps_out_no_other_and_is_named_once() -> None:
    # faults A2
    forwarder = up(most_of_client=3)
    flood = [forwarder.ask(job("flooder", command=False), 0.0) for _ in range(20_000)]
    assert len([refused for refused in flood if refused is not None]) == 20_000 - 3
    assert forwarder.flooders == ("flooder",)
    assert forwarder.ask(job("other", command=False), 1.0) is None
    for n in range(100):
        forwarder.ask(job(f"name {n}", command=False), 1.0)
    assert forwarder.ask(job("holder"), 2.0) is None
    assert forwarder.queue[0].client == "holder"
    assert forwarder.deadline_s() == 5.0
