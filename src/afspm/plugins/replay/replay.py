"""Replay of a recorded run, with a run folder in which programs find the addresses of the replay."""

from __future__ import annotations

import json
import logging
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from afspm import Run, open_run, wire
from afspm.basics import NS_PER_S, ConfigError, ExperimentClock, FileError, Launch, Sockets, is_address
from afspm.client import GUEST
from afspm.model import Frame
from afspm.night import RecordPlayback
from afspm.plugins.replay.replayer import Replayer
from afspm.record import ENDED, EXPERIMENT_FILE, REPLAY_OF, STATE_DIR, lock_run
from afspm.supervisor import FreePorts, run_folder
from afspm.transport import RateLimitedLog, is_local
from afspm.transport.process import signals

BEFORE_S = 1.0
"""Real time before the first packet, so that programs that join at once miss no packet."""


@dataclass(frozen=True)
class ReplayOptions:
    """Options of a replay.

    Attributes:
        speed: experiment seconds per real second; None: as recorded.
        only: names of the messages to publish; empty: all.
        publish, serve: addresses for packets and for requests; None: the addresses in the recorded experiment file if
            only this computer can use them, else free addresses.
        stay: whether to serve late joiners after the last packet.
        runs: parent folder of the replay's run folder.
    """

    speed: float | None = None
    only: Sequence[str] = ()
    publish: str | None = None
    serve: str | None = None
    stay: bool = False
    runs: Path = Path("runs")


def replay(where: Path, options: ReplayOptions, tell: Callable[[str], None]) -> int:
    """Publish a recorded run again until its end or Ctrl-C; return the number of packets published.

    Raises:
        FileError: the record is missing or damaged.
        ConfigError: there is nothing to publish, or a message is unknown.
        TransportError: an address can't be used.
    """
    with open_run(where) as run:
        guest = _guest(run)
        _check(options.only, run)
        found = run.packets(messages=tuple(options.only) or None, tell=lambda why: tell(f"left out: {why}"))
        recorded = RecordPlayback(found)
        if recorded.next_ns is None:
            raise ConfigError("there is nothing to replay", where=str(run.folder))
        clock = _clock(run, options.speed, recorded.next_ns)
        publish, serve = _addresses(run, options)
        complaints = RateLimitedLog(logging.getLogger("afspm.replay"), clock)
        replayer = Replayer(recorded, clock, complaints, publish=publish, serve=serve)
        try:
            with (
                signals.caught(lambda _: replayer.stop(), replayer.wakeup_fileno()),
                _folder(run, options.runs, guest, clock, publish, serve) as folder,
            ):
                message = f"replay of {run.folder.name} at {clock.speed:g} experiment seconds a second, in {folder}"
                tell(f"{message}\npublished at {publish}, requests are refused at {serve}; Ctrl-C ends it")
                replayer.run(stay=options.stay)
        finally:
            replayer.close()
        return replayer.count


def _check(only: Sequence[str], run: Run) -> None:
    # the record describes the user's own messages; importing their module would run code of a stranger's record
    for name in only:
        if name not in wire.known_messages() and next(run.packets(messages=(name,)), None) is None:
            raise ConfigError(f"there is no message {name!r}", where="--only", hint="e.g. Scan2d,ControlState")


def _clock(run: Run, speed: float | None, first_ns: int) -> ExperimentClock:
    recorded = run.facts.get("clock", {})
    start_s = first_ns / NS_PER_S
    speed = float(recorded.get("speed", 1.0)) if speed is None else speed
    return ExperimentClock.starting_now(start_s - BEFORE_S * speed, speed)


def _addresses(run: Run, options: ReplayOptions) -> tuple[str, str]:
    ports = FreePorts()
    addresses = _addresses_of_file(run)
    return options.publish or addresses[0] or ports.address(), options.serve or addresses[1] or ports.address()


def _addresses_of_file(run: Run) -> tuple[str | None, str | None]:
    try:
        tables = [table for table in run.experiment.values() if isinstance(table, dict)]
    except (FileError, tomllib.TOMLDecodeError):
        return None, None
    found: list[str | None] = []
    for key in ("pubsubcache", "router"):
        addresses = (table.get(key) for table in tables if table.get("component"))
        # a replay has no keys; and the address may be of another computer, on which the run was recorded
        found.append(next((a for a in addresses if isinstance(a, str) and is_address(a) and is_local(a)), None))
    return found[0], found[1]


def _guest(run: Run) -> Launch:
    recorded = run.facts.get(GUEST)
    guest = Launch.from_json(json.dumps(recorded)) if isinstance(recorded, dict) else Launch("guest")
    return replace(guest, keys=None, run="", simulated=run.simulated, sample_coordinates=run.frame is Frame.SAMPLE)


@contextmanager
def _folder(run: Run, runs: Path, guest: Launch, clock: ExperimentClock, publish: str, serve: str) -> Iterator[Path]:
    folder = run_folder.create(runs, f"replay-{run.folder.name}", run_folder.now())
    sockets = Sockets(subscribe=(publish,), control=serve)
    joined = replace(
        guest,
        sockets=sockets,
        clock=clock.as_dict(),
        run_dir=str(folder),
        state_dir=str(folder / STATE_DIR),
    )
    source = run.folder / EXPERIMENT_FILE
    if source.is_file():
        run_folder.write_experiment(folder, source.read_text(encoding="utf-8"))
    facts: dict[str, object] = {
        "name": run.name,
        REPLAY_OF: str(run.folder.resolve()),
        "clock": clock.as_dict(),
        "processes": {"replay": {"role": "scheduler", "publish": publish, "serve": serve}},
        GUEST: json.loads(joined.to_json()),
    }
    with lock_run(folder):
        run_folder.write_run(folder, facts)
        try:
            yield folder
        finally:
            run_folder.write_run(folder, {**facts, ENDED: "the replay is over"})
