"""The queue of a reporter without a scheduler stays bounded, and delays no caller."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import pytest
from deadlines import DEADLINE_S

from afspm.basics.clock import ExperimentClock
from afspm.basics.launch import Launch, Sockets
from afspm.model import ControlResponse, Request, Response
from afspm.model.events import LONGEST_ANNOUNCEMENT, LogLines, RelayedMessage
from afspm.supervisor import reporter as reporting
from afspm.supervisor.reporter import Reporter, ReportQueue
from afspm.supervisor.supervision.supervisor_events import (
    AskUse,
    EndExperiment,
    EndRefused,
    SchedulerAnswered,
    UseReported,
)
from afspm.transport.network import Network
from afspm.transport.port import RequestReceived
from afspm.transport.zmq_server import ZmqServerPort
from afspm.wire import decode, decode_request, encode, encode_response

CLOCK = ExperimentClock.real()


@pytest.fixture
def reporter() -> Reporter:
    """A reporter that was not started, so that its queue only grows."""
    return Reporter(Launch("supervisor:lab"), ExperimentClock.real(), "lab")


@pytest.fixture
def queue() -> ReportQueue:
    return ReportQueue(ExperimentClock.real(), "supervisor:lab")


def test_oldest_lines_are_dropped_and_counted(queue: ReportQueue) -> None:
    for n in range(reporting.MOST_LINES + 7):
        queue.put_line("one", "INFO", f"line {n}")
    lines = queue.take_lines()
    assert lines[0].text == "dropped 7 lines that the scheduler did not take"
    assert lines[0].level == "WARNING"
    assert lines[1].text == "line 7"
    assert queue.take_lines()[0].text == f"line {len(lines) + 6}"


def test_a_batch_is_no_longer_than_the_scheduler_takes(queue: ReportQueue) -> None:
    for _ in range(1000):
        queue.put_line("one", "INFO", "µ" * 10_000)
    lines = queue.take_lines()
    assert len(lines[0].text) == reporting.LONGEST_LINE
    assert len(encode(LogLines(lines))[1]) <= LONGEST_ANNOUNCEMENT


class Asked:
    """A reporter on a real socket, and the scheduler that it asks."""

    def __init__(self) -> None:
        self.port = ZmqServerPort(Network(), CLOCK, serve="tcp://127.0.0.1:0", publish=None)
        launch = Launch("supervisor:lab", sockets=Sockets(control=self.port.serve_address))
        self.reporter = Reporter(launch, CLOCK, "lab")
        self.told: list[reporting.ReporterEvent] = []
        self.reporter.post = self.told.append
        self.reporter.start()

    def request(self) -> Request:
        until_s = CLOCK.monotonic_s() + DEADLINE_S
        while CLOCK.monotonic_s() < until_s:
            for one in self.port.poll(0.1):
                if isinstance(one, RequestReceived):
                    return decode_request(one.frames)
        raise TimeoutError

    def answer(self, *responses: Response) -> list[Request]:
        """Answer the next requests; return them once all answers have come, which is when another request comes."""
        requests = []
        for response in responses:
            requests.append(request := self.request())
            self.port.reply(encode_response(replace(response, id=request.id)))
        self.reporter.ask(AskUse())
        self.request()
        return requests

    @property
    def reported(self) -> list[reporting.ReporterEvent]:
        return [one for one in self.told if not isinstance(one, SchedulerAnswered)]

    def close(self) -> None:
        self.reporter.close()
        self.port.close()


@pytest.fixture
def asked() -> Iterator[Asked]:
    with closing(Asked()) as made:
        yield made


def test_debug_lines_are_not_reported(asked: Asked) -> None:
    asked.reporter.line("one", logging.DEBUG, "started, process 7")
    asked.reporter.line("one", logging.INFO, "works")
    (request,) = asked.answer(Response(ControlResponse.SUCCESS))
    assert isinstance(request.subject, RelayedMessage)
    lines = decode(request.subject.message, request.subject.payload).lines
    assert [line.text for line in lines] == ["works"]


def test_unreadable_orders_are_logged_and_reporting_goes_on(asked: Asked) -> None:
    asked.reporter.line("one", logging.INFO, "works")
    asked.answer(Response(ControlResponse.SUCCESS, b"\xff"))
    (complaint,) = asked.reported
    assert isinstance(complaint, reporting.ReportFailed)
    assert "Orders" in complaint.text


@pytest.mark.parametrize(
    ("response", "reported"),
    [
        (
            Response(ControlResponse.SUCCESS, b'{"in_use": "series is in control"}'),
            [UseReported("series is in control")],
        ),
        (Response(ControlResponse.SUCCESS, b'{"in_use": ""}'), [UseReported("")]),
        (Response(ControlResponse.SUCCESS, b"{}"), []),  # an older scheduler can't say
        (Response(ControlResponse.SUCCESS, b"\xff"), []),
        (Response(ControlResponse.FAILURE, b"", "no"), []),
    ],
)
def test_use_of_the_microscope_is_reported_only_if_the_scheduler_knows(
    asked: Asked, response: Response, reported: list[reporting.ReporterEvent]
) -> None:
    asked.reporter.ask(AskUse())
    asked.answer(response)
    assert asked.reported == reported


def test_a_refusal_to_end_is_reported(asked: Asked) -> None:
    asked.reporter.ask(EndExperiment())
    asked.reporter.ask(EndExperiment())
    asked.answer(Response(ControlResponse.SUCCESS), Response(ControlResponse.FAILURE, b"", "not now"))
    assert asked.reported == [EndRefused("not now")]


def test_reporter_that_was_not_started_can_be_closed(reporter: Reporter) -> None:
    reporter.close()
