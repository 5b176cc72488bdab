"""Checks of encryption: a peer without the right key gets no answer and no access."""

from __future__ import annotations

from typing import Any

from afspm.testing.clients.bench import ClientBench, ScriptedRun
from afspm.testing.clients.checks.measure import require_scans, scan_step
from afspm.testing.clients.checks.requests import begin_note, published
from afspm.testing.clients.client_suite import client_check
from afspm.testing.clients.experiment import JUDGE, Security
from afspm.testing.clients.program import ANSWER_S
from afspm.testing.conformance import expect
from afspm.transport.keys import pair

_LISTENED_S = 2.0


@client_check(
    "keys/wrong-key",
    "With a key that the scheduler does not know nothing is executed, and the step is answered.",
    "An unanswered request ends after its repetitions, with `REP_NO_RESPONSE`, though there never was a connection.",
)
def wrong_key(bench: ClientBench) -> None:
    experiment = bench.experiment
    public, secret = pair()
    unknown = {**(experiment.launch.keys or {}), "public": public.decode(), "secret": secret.decode()}
    with bench.client(experiment, ready=False, keys=unknown, request_timeout_s=0.3, request_retries=2) as client:
        answer = client.program.answer(begin_note(experiment, client.program, "wrong key"))
        right = not answer.ok and answer.get("response") == "REP_NO_RESPONSE"
        expect(right, "REP_NO_RESPONSE", str(answer))
    with bench.client(experiment) as client:
        answer = client.program.answer(begin_note(experiment, client.program, "right key"))
        expect(answer.ok, "a success with the right key", str(answer))
        experiment.pump(lambda: published(experiment)["right key"] > 0, 5.0)
    expect(not published(experiment)["wrong key"], "nothing executed with the wrong key", "a note")


@client_check(
    "keys/impostor",
    "Another program that listens at the scheduler's address, without its key, receives nothing.",
    "Set the server key of the address's owner before you connect.",
)
def impostor(bench: ClientBench) -> None:
    for owner in (None, JUDGE):
        with bench.scripted(ready=False, owner=owner) as run:
            _require_silence(run, "no key" if owner is None else "another key")


def _require_silence(run: ScriptedRun, which: str) -> None:
    run.client.begin("request", number=7)
    # on a busy computer the start of a program may take longer than the wait for silence
    has_come = run.scheduler.pump(lambda: run.scheduler.connections > 0, ANSWER_S)
    expect(has_come, "a connection to the scheduler's address", f"none in {ANSWER_S:g} s{run.client.last_words}")
    run.scheduler.serve(_LISTENED_S)
    received = [*run.scheduler.requests, *run.scheduler.greetings, *run.scheduler.prefixes, *run.scheduler.markers]
    expect(not received, f"silence towards a scheduler with {which}", f"{len(received)} messages")


@client_check(
    "keys/requests-only",
    "With the keys that a run makes for itself requests are encrypted and packets plain, and all this works.",
    "An address that is not in `servers` is plain where `everywhere` is false.",
)
def requests_only(bench: ClientBench) -> None:
    _works(bench, Security.REQUESTS)


@client_check(
    "keys/none",
    "Without keys in the launch line all this works, too.",
    "`keys` may be `null`, or have no `secret`: connect plain.",
)
def none(bench: ClientBench) -> None:
    _works(bench, Security.NONE)
    _works(bench, Security.NONE, keys=None)


def _works(bench: ClientBench, security: Security, **changes: Any) -> None:
    experiment = bench.new_experiment(security)
    try:
        with bench.client(experiment, **changes) as client:
            require_scans(experiment, client.program.do("scan", **scan_step()), scan_step())
    finally:
        experiment.close()
