"""Checks of late joining: earlier packets are requested and arrive once."""

from __future__ import annotations

import zmq

from afspm.model import Packet
from afspm.testing.clients.bench import ClientBench, ScriptedRun
from afspm.testing.clients.client_suite import client_check
from afspm.testing.clients.experiment import JudgedExperiment
from afspm.testing.clients.facts import compare
from afspm.testing.clients.golden import golden
from afspm.testing.conformance import Failed, expect
from afspm.transport.frames import receive_frames
from afspm.transport.network import Network
from afspm.wire import KILL, encode_time, followed_messages

_FIRST_NS = 1_767_225_600_000_000_000
_PACKET_S = 10.0


def _notes(*numbers: int) -> list[list[bytes]]:
    note = bytes.fromhex(next(entry["hex"] for entry in golden()["messages"] if entry["type"] == "Note"))
    return [[b"Note", note, encode_time(_FIRST_NS + number * 1_000_000)] for number in numbers]


def _times(run: ScriptedRun, count: int) -> list[int]:
    answers = [run.client.succeed("wait", prefix="Note", timeout_s=_PACKET_S) for _ in range(count)]
    return [(int(answer.get("timestamp_ns") or 0) - _FIRST_NS) // 1_000_000 for answer in answers]


def _nothing_more(run: ScriptedRun) -> None:
    answer = run.client.do_quietly("wait", prefix="Note", timeout_s=0.2)
    expect(not answer.ok, "no packet that was not published, and none twice", str(answer))


@client_check(
    "replay/marker",
    "The client subscribes from an XSUB socket with a marker, to its envelopes.",
    "Send `\\1` and the marker after each connect; see [Replay](wire.md#replay).",
)
def marker(bench: ClientBench) -> None:
    for envelopes in (("Note", "Scan2d_2000"), None):
        with bench.scripted(envelopes=envelopes) as run:
            scheduler = run.scheduler
            expect(scheduler.markers, "a subscription to a marker", f"plain ones alone: {scheduler.prefixes}")
            (asked, *more) = scheduler.markers
            expect(not more, "one marker for a connection", f"{len(more) + 1}")
            expect(asked.since_ns == -1, "a marker that asks for all (-1)", f"since {asked.since_ns}")
            wanted = {"", KILL.decode()} if envelopes is None else {*envelopes, KILL.decode()}
            # every client may follow the state and its own measurements
            unasked = set(asked.prefixes) - wanted - set(followed_messages())
            expect(not unasked, f"the prefixes {sorted(wanted)}, and those of the state", f"also {sorted(unasked)}")
            missing = (wanted - {KILL.decode()}) - set(asked.prefixes)
            expect(not missing, f"the prefixes {sorted(wanted)}", f"none for {sorted(missing)}")


@client_check(
    "replay/late-joiner",
    "What was published before the client came arrives once, oldest first, only what it asked for, "
    "and no other subscriber gets it again.",
    "Deliver the packets under your marker's topic before the following ones; compare envelopes with your prefixes.",
)
def late_joiner(bench: ClientBench) -> None:
    with bench.scripted(ready=False, envelopes=("Note",)) as run:
        run.scheduler.cached = _notes(1, 2, 3)
        run.client.succeed("ready")
        for frames in _notes(4, 5):
            run.scheduler.publish(*frames)
        came = _times(run, 5)
        expect(came == [1, 2, 3, 4, 5], "the packets 1, 2, 3 of the replay, then 4, 5", str(came))
        _nothing_more(run)
    _in_an_experiment(bench, bench.experiment)


def _in_an_experiment(bench: ClientBench, experiment: JudgedExperiment) -> None:
    for number in range(3):
        experiment.scope.note(f"late joining {number}")
    network = Network.from_launch("judge", dict(experiment.launch.keys or {}) or None)
    try:
        plain = network.socket(zmq.SUB)
        plain.setsockopt(zmq.SUBSCRIBE, b"Note")
        network.connect(plain, experiment.launch.sockets.subscribe[0])
        plain.poll(5_000)
        experiment.pump(lambda: False, 0.3)
        while receive_frames(plain):
            pass
        notes: list[Packet] = experiment.packets("Note")
        with bench.client(experiment, envelopes=("Note",)) as client:
            for note in notes:
                compare(client.program.succeed("wait", prefix="", timeout_s=_PACKET_S), note)
            experiment.pump(lambda: False, 0.3)
        if receive_frames(plain):
            raise Failed("nothing that others hear again", "the replay as ordinary packets")
    finally:
        network.close()


@client_check(
    "replay/second-publisher",
    "A publisher besides the scheduler, which knows no markers, is listened to as well.",
    "Connect to each address in `sockets.subscribe`, with the key of its owner; "
    "only the scheduler, the first, is to have caught up.",
)
def second_publisher(bench: ClientBench) -> None:
    with bench.second_publisher() as (address, publish), bench.scripted(also=address, envelopes=("Note",)) as run:

        def again() -> bool:
            publish(*_notes(1)[0])
            return run.client.is_answered(step)

        step = run.client.begin("wait", prefix="Note", timeout_s=_PACKET_S)
        tries = 0
        while not again() and (tries := tries + 1) < 50:
            run.scheduler.serve(0.1)
        answer = run.client.answer(step)
        expect(answer.ok, "the packet of another component's publisher", str(answer))


@client_check(
    "replay/reconnect",
    "After a lost connection the client requests packets newer than its newest one, and delivers none twice.",
    "Send a new marker after each connect, with the newest time in it; drop packets not newer than the last of their "
    "envelope.",
)
def reconnect(bench: ClientBench) -> None:
    with bench.scripted(envelopes=("Note",)) as run:
        scheduler = run.scheduler
        for frames in _notes(1, 2):
            scheduler.publish(*frames)
        first = _times(run, 2)
        expect(first == [1, 2], "the packets 1, 2", str(first))
        scheduler.shut()
        scheduler.cached = _notes(1, 2, 3)
        scheduler.open()
        again = scheduler.pump(lambda: len(scheduler.markers) > 1, 10.0)
        expect(again, "a new marker after the connection was lost", "none in 10 s")
        since_ns, newest_ns = scheduler.markers[-1].since_ns, _FIRST_NS + 2_000_000
        expect(since_ns == newest_ns, f"a marker that requests packets newer than {newest_ns}", f"since {since_ns}")
        scheduler.publish(*_notes(4)[0])
        came = _times(run, 2)
        expect(came == [3, 4], "the packets 3, which was missed, and 4", str(came))
        _nothing_more(run)
