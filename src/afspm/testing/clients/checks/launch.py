"""Checks of the program's start, heartbeats and end."""

from __future__ import annotations

from afspm.basics.exit_codes import ExitCode
from afspm.model.requests import OTHER_RUN_RESPONSE
from afspm.testing.clients.bench import BEAT_S, TOKEN, ClientBench
from afspm.testing.clients.client_suite import client_check
from afspm.testing.clients.heartbeats import BeatRecorder
from afspm.testing.clients.program import ClientProgram, Pump
from afspm.testing.conformance import expect
from afspm.wire import BEAT, KILL

ENDED_S = 4.0
"""Twice the documented limit, for a busy computer."""
_WATCHED_S = 5.0
_MOST_BEATS_APART = 4.0
"""Longest pause in heartbeat periods: three missed beats count as dead; one more for a busy computer."""


def await_beat(beats: BeatRecorder, pump: Pump) -> None:
    """Wait for the first heartbeat, which shows that the subscription works."""
    pump(lambda: bool(beats.beats), _MOST_BEATS_APART * BEAT_S)


def require_beats(beats: BeatRecorder, since_s: float) -> None:
    """Raise Failed if a pause between heartbeats since `since_s` was longer than `_MOST_BEATS_APART` periods."""
    pause_s = beats.longest_pause_s(since_s)
    expect(pause_s <= _MOST_BEATS_APART * BEAT_S, f"a beat every {BEAT_S} s", f"a pause of {pause_s:.1f} s")


def require_exit(program: ClientProgram, codes: tuple[int, ...]) -> None:
    ended = program.wait_ended(ENDED_S)
    wanted = " or ".join(str(int(code)) for code in codes)
    expect(ended, f"the end of the program within {ENDED_S:.0f} s", f"a program that goes on{program.last_words}")
    expect(program.exit_code in codes, f"the exit code {wanted}", f"{program.ending}{program.last_words}")


def require_end(program: ClientProgram, beats: BeatRecorder, pump: Pump, codes: tuple[int, ...]) -> None:
    """Raise Failed unless the program ends in time, with an allowed exit code and a closing heartbeat."""
    require_exit(program, codes)
    pump(lambda: any(beat.closing for beat in beats.beats), 1.0)
    came = f"{len(beats.beats)} that do not" if beats.beats else "no heartbeat at all"
    expect(beats.beats and beats.beats[-1].closing, "a last heartbeat that says closing (1)", came)


@client_check(
    "launch/heartbeats",
    "The first beat comes within the start time, then one a period, with the token, also during a long step.",
    "Beat from a thread of its own: four frames, the last is `beat_token`.",
)
def heartbeats(bench: ClientBench) -> None:
    with bench.scripted() as run:
        since_s = bench.clock.monotonic_s()
        step = run.client.begin("wait", prefix="Scan2d_never", timeout_s=_WATCHED_S)
        run.scheduler.serve(_WATCHED_S)
        require_beats(run.beats, since_s)
        most = 2 + 4 * _WATCHED_S / BEAT_S
        count = sum(beat.at_s > since_s for beat in run.beats.beats)
        expect(count <= most, f"a beat every {BEAT_S} s", f"{count} beats in {_WATCHED_S:.0f} s")
        for beat in run.beats.beats:
            proper = len(beat.frames) == 4 and beat.frames[0] == BEAT and beat.frames[3] == TOKEN.encode()
            expect(proper, "beats of four frames: 0, two that may be empty, beat_token", str(beat.frames))
        expect(not run.client.answer(step).ok, "no packet", "one that was never published")


@client_check(
    "launch/stdin",
    "The program ends by itself when its standard input does, with the exit code 0 or 81, after a closing beat.",
    "Read standard input in a thread of its own; at its end send the beat 1, close the sockets with a short linger, "
    "and end.",
)
def stdin(bench: ClientBench) -> None:
    with bench.scripted() as run:
        run.client.begin("wait", prefix="Scan2d_never", timeout_s=60.0)
        run.scheduler.serve(0.2)
        await_beat(run.beats, run.scheduler.pump)
        run.client.close_stdin()
        require_end(run.client, run.beats, run.scheduler.pump, (ExitCode.DONE, ExitCode.ORPHAN))
    with bench.scripted(ready=False) as run:  # it must also end before it is connected
        run.scheduler.shut()
        run.scheduler.open()
        run.client.close_stdin()
        ended = run.client.wait_ended(ENDED_S + 3.0)
        expect(ended, "the end of a program that has just been started", "a program that goes on")


@client_check(
    "launch/end",
    "The program ends with the exit code 80 when the experiment ends, after a closing beat.",
    "Subscribe to `KILL`; end with 80, though standard input is open.",
)
def end(bench: ClientBench) -> None:
    for envelopes in (None, ("Scan2d",)):
        with bench.scripted(envelopes=envelopes) as run:
            run.client.begin("wait", prefix="Scan2d_never", timeout_s=60.0)
            run.scheduler.serve(0.2)
            await_beat(run.beats, run.scheduler.pump)
            run.scheduler.publish(KILL)
            require_end(run.client, run.beats, run.scheduler.pump, (ExitCode.ENDED,))
    experiment = bench.new_experiment()
    try:
        with bench.client(experiment) as client:
            await_beat(client.beats, experiment.pump)
            client.program.begin("end")
            require_end(client.program, client.beats, experiment.pump, (ExitCode.ENDED,))
    finally:
        experiment.close()


@client_check(
    "launch/other-run",
    "A client that reaches the scheduler of another run ends with the exit code 78.",
    "Send the request 101 as soon as you are connected, and end if a response is 100.",
)
def other_run(bench: ClientBench) -> None:
    with bench.scripted(ready=False) as run:
        run.scheduler.greeting = lambda request: [request.answered(OTHER_RUN_RESPONSE, b"", "this is another run")]
        greeted = run.scheduler.pump(lambda: bool(run.scheduler.greetings), 10.0)
        expect(greeted, "the request 101 as soon as the client is connected", "none")
        require_exit(run.client, (ExitCode.CONFIG,))
