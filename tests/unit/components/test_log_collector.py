"""Log lines from processes to one file."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

from client_lab import Lab, run

from afspm.clock import ExperimentClock
from afspm.components.log_collector import LogCollector, told
from afspm.transport.log_link import LogLine, LogReceiver, LogSender, read_line
from afspm.transport.network import Network


def test_a_line_says_when_how_bad_who_and_what() -> None:
    line = told(LogLine("scheduler", logging.WARNING, 1_700_000_000_000_000_000, "first\nsecond"))
    assert line == "2023-11-14T22:13:20.000000Z WARNING  scheduler        first\n    second"


def test_what_is_sent_is_received_and_what_is_no_line_is_left_out() -> None:
    receiver = LogReceiver(Network(), "tcp://127.0.0.1:0")
    sender = LogSender(Network(), receiver.address, "metadata")
    deadline_s = time.monotonic() + 10.0
    found: list[LogLine] = []
    while not found and time.monotonic() < deadline_s:  # what is said before the connection stands is lost
        sender.send(logging.INFO, 5, "the tip is blunt: 40 % … µm, \udcff.ibw")
        found = receiver.take()
    sender.close()
    receiver.close()
    assert found[0] == LogLine("metadata", logging.INFO, 5, "the tip is blunt: 40 % … µm, \\udcff.ibw")
    assert read_line([b"a", b"INFO", b"5", b"text"]) is None
    assert read_line([b"a"]) is None


def test_the_component_writes_what_comes_until_the_end(tmp_path: Path) -> None:
    lab = Lab("logs")
    collector = LogCollector(address="tcp://127.0.0.1:0", level="WARNING")

    def say() -> None:
        # through the component's own receiver, whose network is not what is tested here
        lines = [LogLine("tip", logging.WARNING, 0, "bad"), LogLine("tip", logging.INFO, 0, "good")]
        collector.receiver.take = lambda: [lines.pop()] if lines else []  # type: ignore[method-assign]

    lab.at(1.0, say)
    lab.at(3.0, lab.kill)
    run(collector, lab, run_dir=str(tmp_path))
    assert (tmp_path / "log-all.txt").read_text() == "1970-01-01T00:00:00.000000Z WARNING  tip              bad\n"


def test_the_last_words_of_those_that_end_are_waited_for() -> None:
    receiver = LogReceiver(Network(), "tcp://127.0.0.1:0")
    senders = [LogSender(Network(), receiver.address, name) for name in ("scheduler", "series")]
    deadline_s = time.monotonic() + 10.0
    heard: set[str] = set()
    while len(heard) < 2 and time.monotonic() < deadline_s:
        for sender in senders:
            sender.send(logging.INFO, 5, "here")
        heard |= {line.name for line in receiver.take()}

    def end() -> None:
        for sender in senders:
            sender.send(logging.INFO, 6, "the end")
            sender.close()

    ending = threading.Timer(0.05, end)
    ending.start()
    began_s = time.monotonic()
    rest = receiver.take_rest(10.0, ExperimentClock.real())
    assert time.monotonic() - began_s < 5.0, "it waits although nobody is there any more"
    assert {line.name for line in rest if line.text == "the end"} == {"scheduler", "series"}
    ending.join()
    receiver.close()
