"""`Recorder`: the component that keeps the record of a run; part of every experiment unless [record] is off."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from afspm.basics.exit_codes import ExitCode
from afspm.basics.plain_data import Plain
from afspm.basics.toml import parse_toml
from afspm.client.component import Component
from afspm.model import Frame, ProblemNames, ProcessStates
from afspm.record.run_json import EXPERIMENT_FILE, METADATA, experiment_name, run_json_or_empty
from afspm.storage import log_folder
from afspm.storage.packet_log import LogReader, commit, committed
from afspm.storage.segment import segments
from afspm.transport import step_back
from afspm.transport.port import Killed, PacketReceived, ParentGone

if TYPE_CHECKING:
    from afspm.basics.clock import Clock
    from afspm.basics.launch import Launch
    from afspm.record.store import RecordSettings
    from afspm.transport.process.context import ProcessContext

REST_S = 0.5
"""Shortest real time to stay after the end of the experiment, for the last packets of other components."""
LONGEST_REST_S = 30.0
"""Longest real time to stay after the end; usually the supervisor ends the recorder before."""
MOST_LAST_BYTES = 1 << 20
SIGNS_OF_LIFE = ("ControlState",)
"""The subscription to a scheduler whose log is read: only a sign that the scheduler is alive."""


class Recorder(Component):
    """The writer of `journal.sqlite`, and of an HDF5 file for every scan and spectrum, in the run folder.

    The recorder follows the scheduler's packet log at low processor priority. Even if all processes are killed at once,
    the record of a resumed run has each published packet exactly once. A full disk is logged; the experiment goes on,
    and missed packets are recorded once there is room, as far as the log still has them.

    Args:
        scans: whether to keep scans and spectra; otherwise only the journal.
    """

    listens: ClassVar = ("",)
    records: ClassVar[bool] = True
    longest_step_s: ClassVar[float] = 120.0

    def __init__(self, scans: bool = True) -> None:
        self.scans = scans

    def run_process(self, context: ProcessContext) -> int:
        from afspm.components.recording import RecordWriter
        from afspm.record.journal import SCHEDULER

        step_back()
        launch = context.launch
        run_dir = Path(launch.run_dir or ".")
        context.activity.longest_step_s = self.longest_step_s
        # a scheduler with a log need not send all packets, too
        heard = SIGNS_OF_LIFE if len(launch.sockets.subscribe) == 1 else None
        port = context.open_port(heard)
        source = launch.sockets.subscribe[0] if launch.sockets.subscribe else ""
        log = log_folder(Path(launch.state_dir or run_dir))
        writer = RecordWriter(
            run_dir,
            log,
            _settings(launch, context.clock, scans=self.scans),
            context.clock,
            context.log,
            step=context.activity.step,
            wake=lambda: port.wake_up(),  # the port may have been replaced by then
        )
        writer.start()
        ended_s, until_s, is_to_ask_again = math.inf, math.inf, False
        try:
            while (left_s := until_s - context.clock.monotonic_s()) > 0.0:
                for incoming in port.poll(None if left_s == math.inf else left_s):
                    match incoming:
                        case PacketReceived() if incoming.source != source:
                            writer.put(incoming.packet, incoming.source)
                        case PacketReceived() if heard is None and not segments(log):
                            writer.put(incoming.packet, SCHEDULER)
                        case PacketReceived() if not segments(log):  # a scheduler of another make keeps no log
                            heard, is_to_ask_again = None, True
                        case Killed():
                            ended_s = min(ended_s, context.clock.monotonic_s())
                            until_s = min(until_s, ended_s + LONGEST_REST_S)
                        case ParentGone() if ended_s < math.inf:
                            until_s = ended_s + REST_S
                        case ParentGone():
                            writer.finish(ended=False)
                            return ExitCode.ORPHAN
                writer.check()
                if writer.wants_replay() or is_to_ask_again:
                    is_to_ask_again = False
                    port.close()
                    port = context.open_port(heard)
            writer.finish(ended=True)
            return ExitCode.ENDED
        finally:
            port.close()


def record_last_reports(launch: Launch, clock: Clock) -> None:
    """Record the reports of processes that came after a recorder's end, so that its run needs no packet log any more.

    The last report, that the recorder itself has ended, always comes too late for it. If the log holds anything else
    that is not recorded, or the recorder's class is a user's own, nothing is done, and the log stays.

    Args:
        launch: the recorder's launch line.

    Raises:
        OSError: the log can't be read, or the disk is full.
        FileError, sqlite3.Error: the journal is damaged.
    """
    from afspm.record.journal import SCHEDULER
    from afspm.record.store import RecordStore

    log = log_folder(Path(launch.state_dir or launch.run_dir))
    position = committed(log)
    if launch.class_ != f"{Recorder.__module__}.{Recorder.__name__}" or position is None:
        return
    left = LogReader(log, position).read(MOST_LAST_BYTES)
    packets = [entry.packet for entry, _ in left]
    if not left or any(packet.envelope.partition("_")[0] != ProcessStates.__name__ for packet in packets):
        return
    settings = _settings(launch, clock, scans=bool(launch.settings.get("scans", True)))
    with closing(RecordStore(Path(launch.run_dir), settings)) as store:
        store.take((packet, SCHEDULER) for packet in packets)
        store.sync()
        commit(log, left[-1][1])
        store.settle()


def _settings(launch: Launch, clock: Clock, *, scans: bool) -> RecordSettings:
    from afspm.record.store import RecordSettings
    from afspm.wire.described_types import describe

    run_dir = Path(launch.run_dir or ".")
    frame = Frame.SAMPLE if launch.sample_coordinates else Frame.TIP
    facts: Plain = {
        "experiment": experiment_name(run_dir),
        "run": run_dir.resolve().name,
        "simulated": launch.simulated,
        "seeds": _seeds(run_dir / EXPERIMENT_FILE),
        "frame": frame.value,
        METADATA: run_json_or_empty(run_dir).get(METADATA, {}),
    }
    problems = ProblemNames(launch.problems)
    speed = 1.0 / clock.real_s(1.0)
    return RecordSettings(facts, problems, frame, measured=scans, speed=speed, messages=describe())


def _seeds(file: Path) -> Plain:
    try:
        said = parse_toml(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return {name: table["seed"] for name, table in said.items() if isinstance(table, dict) and "seed" in table}
