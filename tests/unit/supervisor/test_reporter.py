"""The queue of a reporter without a scheduler stays bounded, and delays no caller."""

from __future__ import annotations

import logging

import pytest

from afspm.basics.clock import ExperimentClock
from afspm.basics.launch import Launch
from afspm.model import CLOCK_REQUEST, RELAY_REQUEST, ControlRequest, ControlResponse, Response
from afspm.model.events import LONGEST_ANNOUNCEMENT, LogLines
from afspm.supervisor import reporter as reporting
from afspm.supervisor.reporter import Reporter, ReportQueue
from afspm.supervisor.supervision.supervisor_events import EndRefused, UseReported
from afspm.wire import encode


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


def test_debug_lines_are_not_reported(reporter: Reporter) -> None:
    reporter.line("one", logging.DEBUG, "started, process 7")
    assert reporter._queue.take_lines() == ()


def test_unreadable_orders_are_logged_and_reporting_goes_on(reporter: Reporter) -> None:
    told: list[reporting.ReporterEvent] = []
    reporter.post = told.append
    reporter._answered(RELAY_REQUEST, Response(ControlResponse.SUCCESS, b"\xff"))
    (complaint,) = told
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
    reporter: Reporter, response: Response, reported: list[reporting.ReporterEvent]
) -> None:
    told: list[reporting.ReporterEvent] = []
    reporter.post = told.append
    reporter._answered(CLOCK_REQUEST, response)
    assert told == reported


def test_a_refusal_to_end_is_reported(reporter: Reporter) -> None:
    told: list[reporting.ReporterEvent] = []
    reporter.post = told.append
    reporter._answered(ControlRequest.END_EXPERIMENT, Response(ControlResponse.SUCCESS))
    assert told == []
    reporter._answered(ControlRequest.END_EXPERIMENT, Response(ControlResponse.FAILURE, b"", "not now"))
    assert told == [EndRefused("not now")]


def test_reporter_that_was_not_started_can_be_closed(reporter: Reporter) -> None:
    reporter.close()
