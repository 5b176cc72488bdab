"""Examination of an experiment from one of its computers, before, during or after its run."""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import psutil
from rich.console import Console
from rich.text import Text

from afspm import wire
from afspm.basics import entry_points
from afspm.basics.addresses import connectable
from afspm.basics.clock import NS_PER_S, ExperimentClock
from afspm.basics.errors import AfspmError
from afspm.basics.formatting import duration_text
from afspm.basics.launch import Launch, Sockets
from afspm.basics.plain_data import Plain
from afspm.cli import contacting
from afspm.client.component import Component
from afspm.client.connect import find_run, guest_of
from afspm.experiment import Experiment, Role
from afspm.model import CLOCK_REQUEST, ProcessCondition, ProcessStates, Request
from afspm.model.events import SUPERVISOR
from afspm.record import goes_on
from afspm.supervisor.reporter import computer_name
from afspm.translator.trace import FILE as TRACE_FILE
from afspm.translator.trace import load_of, newest_lines
from afspm.transport import diagnosis, keys, probe
from afspm.transport.diagnosis import Diagnosis, Handshake, Heard, Reach, Severity, Versions
from afspm.transport.network import Network
from afspm.transport.port import CaughtUp, ControlConnected, PacketReceived, ReplyReceived
from afspm.transport.zmq_port import open_port
from afspm.wire.message_types import register_all

_COLOURS = {"fine": "green", "warning": "yellow", "error": "bold red"}
_PROBE_BYTES = 16 << 20  # written once to measure the disk
# keys that are usually on any computer of an experiment; else any key found there is used
_ASKED_AS = (SUPERVISOR, "terminal")
_ILL = (ProcessCondition.SILENT, ProcessCondition.RESTARTING, ProcessCondition.GIVEN_UP)


@dataclass
class Examination:
    """Findings, rates of packets by envelope, and pids of the experiment's processes on this computer."""

    found: list[Diagnosis] = field(default_factory=list)
    heard: list[Heard] = field(default_factory=list)
    pids: dict[str, int] = field(default_factory=dict)

    @property
    def is_well(self) -> bool:
        return diagnosis.is_well(self.found)


def examine(
    experiment: Experiment | None,
    runs: Path,
    listen_s: float,
    commands: Collection[str] = (),
    *,
    everything: bool = False,
) -> Examination:
    """Examine an experiment from this computer, and count its scheduler's packets for `listen_s` of real time.

    A real controller is asked for its settings. Without an experiment, or with errors in its file, only this
    computer is examined.

    Args:
        commands: names of afspm's own commands, which no package can replace.
        everything: whether to list all parameters of the controller.
    """
    examination = Examination([] if experiment is None else [*_file(experiment)])
    examination.found += diagnosis.of_packages(entry_points.inventory(commands))
    is_right = diagnosis.is_well(examination.found)
    if experiment is not None and (is_right or not experiment.resolved.with_role(Role.SCHEDULER)):
        kind, settings = experiment.resolved.driver()  # also of an instrument's file alone, which is no experiment
        if kind is not None:
            examination.found += contacting.asked(kind, settings, everything=everything)[1]
    if experiment is not None and is_right:
        examination.found += _keys(experiment)
        _Connections(experiment, examination).examine(listen_s)
        examination.found += _devices(experiment)
        examination.found += _load(experiment)
    examination.found += _disk(runs)
    examination.found.append(diagnosis.of_memory(psutil.virtual_memory().available, _sizes(examination.pids)))
    return examination


def show(found: Collection[Diagnosis], *, everything: bool = True) -> None:
    """Print diagnoses, the faults last, where one looks.

    Args:
        everything: whether to print the offers of all packages, which do not depend on an experiment.
    """
    console = Console(highlight=False)
    for one in sorted(found, key=lambda one: list(Severity).index(one.severity)):
        if (one.code, one.severity) == ("package", Severity.FINE) and not everything:
            continue
        word = one.severity.value
        line = Text.assemble((f"{word:8}", _COLOURS[word]), (one.where, "bold"), f": {one.what}")
        if one.remedy:
            line.append(f"\n        {one.remedy}", "dim")
        console.print(line, soft_wrap=True)


def _file(experiment: Experiment) -> Iterator[Diagnosis]:
    errors = [error for error in experiment.check() if error.is_error]
    for error in errors:
        yield Diagnosis("file", Severity.ERROR, str(error.place), error.what, error.hint)
    if not errors:
        yield diagnosis.fine("file", str(experiment.files[0]), "nothing wrong")
        for translator in experiment.resolved.with_role(Role.TRANSLATOR):
            if (has := translator.capabilities()) is not None:
                yield diagnosis.fine("channels", translator.name, f"it may have {has.channels.described()}")
                yield diagnosis.fine("bias", translator.name, has.bias.text)
            for lost in experiment.resolved.lost_without():
                what, _, hint = lost.partition("; ")
                yield Diagnosis("withdrawal", Severity.WARNING, translator.name, what, hint)


def _keys(experiment: Experiment) -> Iterator[Diagnosis]:
    if (folder := experiment.keys_folder) is None:
        return
    here = sorted(file.stem for file in (folder / "private").glob("*.key_secret"))
    wrong = False
    for name in here:
        try:
            own = keys.load(folder, name)
            if name in own.peers.values() and own.public not in own.peers:
                what, hint = "is not the public part of the secret key here", "make both again, or copy the right one"
                yield Diagnosis("key-pair", Severity.ERROR, str(folder / "public" / f"{name}.key"), what, hint)
                wrong = True
        except AfspmError as error:
            wrong = True
            yield Diagnosis("key-file", Severity.ERROR, error.where, error.what, error.hint)
    needed = {SUPERVISOR, *experiment.component_names}
    for name in sorted(needed - {file.stem for file in (folder / "public").glob("*.key")}):
        wrong = True
        what, hint = f"there is no public key of {name}", "`afspm keys` makes it; copy keys/public to every computer"
        yield Diagnosis("key-missing", Severity.ERROR, str(folder / "public"), what, hint)
    if SUPERVISOR not in here:
        wrong = True
        what, hint = "the key of supervisor is not on this computer", "copy private/supervisor.key_secret here"
        yield Diagnosis("key-missing", Severity.ERROR, str(folder / "private"), what, hint)
    if not wrong:
        yield diagnosis.fine("keys", str(folder), f"secret keys here: {', '.join(here)}")


def _devices(experiment: Experiment) -> Iterator[Diagnosis]:
    for process in experiment.resolved.with_role(Role.COMPONENT):
        class_ = process.component
        if class_ is None or not issubclass(class_, Component) or not entry_points.is_declared(class_):
            continue
        if class_.try_connection is Component.try_connection:
            continue
        try:
            if what := class_(**process.settings).try_connection():
                yield diagnosis.fine("device", process.name, what)
        except AfspmError as error:
            yield Diagnosis("device", Severity.ERROR, f"{process.name} at {error.where}", error.what, error.hint)
        except Exception as error:  # of a class of another package, which may raise anything
            what = f"can't be tried: {type(error).__name__}: {error}"
            yield Diagnosis("device", Severity.ERROR, process.name, what, f"mend {class_.__qualname__}")


def _load(experiment: Experiment) -> Iterator[Diagnosis]:
    # only a run with a trace shows what it asks of the controller: `afspm shadow` and `afspm trace` keep one
    with suppress(AfspmError, OSError):
        folder = find_run(experiment.files[0])
        if goes_on(folder) and (load := load_of(newest_lines(folder / TRACE_FILE))) is not None:
            what = f"{load}, over the last {duration_text(load.over_s)}"
            severity = Severity.WARNING if load.lost else Severity.FINE
            remedy = "raise `poll_period_s` of [microscope] if the controller is slow" if load.lost else ""
            yield Diagnosis("load", severity, "controller", what, remedy)


def _disk(runs: Path) -> Iterator[Diagnosis]:
    folder = next(parent for parent in (runs.resolve(), *runs.resolve().parents) if parent.is_dir())
    clock, file = ExperimentClock.real(), folder / f".afspm-doctor-{os.getpid()}"
    try:
        began_s = clock.monotonic_s()
        with file.open("wb") as stream:
            stream.write(bytes(_PROBE_BYTES))
            stream.flush()
            os.fsync(stream.fileno())
        speed = _PROBE_BYTES / max(clock.monotonic_s() - began_s, 1e-6)
        yield from diagnosis.of_disk(str(folder), shutil.disk_usage(folder).free, speed)
    except OSError as error:
        what = f"can't be written: {error.strerror or error}"
        yield Diagnosis("disk", Severity.ERROR, str(folder), what, "choose another folder with --runs")
    finally:
        file.unlink(missing_ok=True)


def _sizes(pids: Mapping[str, int]) -> dict[str, int]:
    sizes: dict[str, int] = {}
    for name, pid in pids.items():
        with suppress(psutil.Error):
            sizes[name] = int(psutil.Process(pid).memory_info().rss)
    return sizes


class _Connections:
    """An examiner of an experiment's addresses, then of its scheduler."""

    def __init__(self, experiment: Experiment, into: Examination) -> None:
        self._experiment, self._into = experiment, into
        self._scheduler = next((part.name for part in experiment.resolved.with_role(Role.SCHEDULER)), "scheduler")

    def examine(self, listen_s: float) -> None:
        """Examine addresses, keys, clock, versions, and published packets."""
        reached = self._addresses()
        launch = self._launch()
        if launch is None or not launch.sockets.control:
            what, hint = "nothing runs here, and the file has no addresses", "`afspm run` starts it"
            self._into.found.append(Diagnosis("not-running", Severity.WARNING, "scheduler", what, hint))
        elif reached.get(launch.sockets.control, probe.reach(launch.sockets.control)) is Reach.OPEN:
            self._speak(launch, listen_s)
        if not any(finding.code == "versions" for finding in self._into.found):
            self._into.found.append(diagnosis.of_versions(probe.versions_here(), None))

    def _addresses(self) -> dict[str, Reach]:
        slots = [slot for slot in self._experiment.resolved.net.slots.values() if slot.address]
        reached = {
            slot.address: (slot, probe.reach(connectable(slot.address)))
            for slot in slots
            if slot.address is not None and slot.address.startswith("tcp://")
        }
        runs = any(slot.owner == self._scheduler and reach is Reach.OPEN for slot, reach in reached.values())
        for address, (slot, reach) in reached.items():
            is_here = probe.is_of_this_computer(address)
            diagnosed = diagnosis.of_address(slot.owner, address, reach, is_here=is_here, expected=runs or not is_here)
            self._into.found.append(diagnosed)
        return {connectable(address): reach for address, (_, reach) in reached.items()}

    def _launch(self) -> Launch | None:
        # a run that goes on here is joined as a guest: keys made for a run are in its folder, not in the file
        experiment = self._experiment
        asking = experiment.asking([part.name for part in experiment.resolved.with_role(Role.COMPONENT)])
        publish = experiment.resolved.net.slots.get(f"{self._scheduler}/publish")
        written = None if publish is None or publish.address is None else connectable(publish.address)
        guest = None if experiment.keys_folder else self._guest()
        if guest is not None or asking is None or written is None:
            return guest
        known_keys = None if asking.keys is None else {**asking.keys, written: self._scheduler}
        sockets = Sockets(subscribe=(written,), control=asking.sockets.control)
        name, messages = f"{self._owner_of_key()}:doctor-{os.getpid()}", experiment.resolved.messages
        return replace(asking, name=name, sockets=sockets, keys=known_keys, messages=messages)

    def _guest(self) -> Launch | None:
        try:
            folder = find_run(self._experiment.files[0])
            return guest_of(folder, f"guest:doctor-{os.getpid()}") if goes_on(folder) else None
        except AfspmError:
            return None

    def _owner_of_key(self) -> str:
        folder = self._experiment.keys_folder
        here = [] if folder is None else [file.stem for file in sorted((folder / "private").glob("*.key_secret"))]
        return next((name for name in (*_ASKED_AS, *here) if name in here), SUPERVISOR)

    def _speak(self, launch: Launch, listen_s: float) -> None:
        address, owner = str(launch.sockets.control), launch.name.partition(":")[0]
        try:
            network = Network.from_launch(launch.name, launch.keys)
            try:
                shaken = probe.handshake(network, address)
            finally:
                network.close()
            self._into.found.append(diagnosis.of_handshake(address, shaken, owner, self._scheduler))
            if shaken is Handshake.DONE:
                register_all(self._experiment.resolved.messages)
                self._listen(launch, listen_s)
        except AfspmError as error:
            self._into.found.append(Diagnosis("key-file", Severity.ERROR, error.where, error.what, error.hint))

    def _listen(self, launch: Launch, listen_s: float) -> None:
        wall = ExperimentClock.real()
        port = open_port(launch, wall)
        until_s, asked_s, caught_up_s = wall.monotonic_s() + listen_s + probe.WITHIN_S, 0.0, None
        counts, sizes = Counter[str](), Counter[str]()
        try:
            while (left_s := until_s - wall.monotonic_s()) > 0.0:
                for incoming in port.poll(left_s):
                    if isinstance(incoming, ControlConnected):
                        asked_s = wall.now_s()
                        port.send(wire.encode_request(Request(CLOCK_REQUEST, id=f"{launch.name}/doctor/1")))
                    elif isinstance(incoming, ReplyReceived) and incoming.response.ok:
                        self._compare(json.loads(incoming.response.payload), asked_s, wall.now_s())
                    elif isinstance(incoming, CaughtUp):
                        caught_up_s = wall.monotonic_s()
                        until_s = caught_up_s + listen_s
                    elif isinstance(incoming, PacketReceived):
                        packet = incoming.packet
                        if packet.envelope.startswith(ProcessStates.__name__):
                            self._processes(wire.decode(ProcessStates.__name__, packet.payload))
                        if caught_up_s is not None:
                            counts[packet.envelope] += 1
                            sizes[packet.envelope] += len(packet.payload)
        finally:
            port.close()
        self._into.heard = [Heard(name, counts[name], sizes[name], listen_s) for name in sorted(counts)]
        diagnosed = diagnosis.of_publisher(
            launch.sockets.subscribe[0], self._into.heard, caught_up=caught_up_s is not None
        )
        self._into.found.append(diagnosed)

    def _compare(self, answer: Plain, asked_s: float, answered_s: float) -> None:
        if not answer.get("waits"):  # simulated time that waits for late processes does not show real time
            now_s, start_s, origin_s, speed = (
                float(answer[name]) for name in ("now_ns", "start_s", "origin_s", "speed")
            )
            real_s = origin_s + (now_s / NS_PER_S - start_s) / speed
            ahead_s, uncertain_s = (asked_s + answered_s) / 2 - real_s, (answered_s - asked_s) / 2
            self._into.found.append(diagnosis.of_clock(ahead_s, uncertain_s))
        versions = answer.get("versions")
        theirs = Versions(**versions) if isinstance(versions, dict) else None
        self._into.found.append(diagnosis.of_versions(probe.versions_here(), theirs))

    def _processes(self, states: object) -> None:
        if not isinstance(states, ProcessStates):
            return
        if states.supervisor.startswith(computer_name()):
            self._into.pids |= {process.name: process.pid for process in states.processes if process.pid}
        known = {finding.where for finding in self._into.found if finding.code == "process"}
        for process in states.processes:
            where = f"{process.name} on {states.supervisor}"
            if process.condition in _ILL and where not in known:
                what = process.condition.name.lower().replace("_", " ")
                hint = f"its log says why; `afspm restart {process.name}` starts it again"
                self._into.found.append(Diagnosis("process", Severity.ERROR, where, what, hint))
