"""Checks of requests: ids, repetition, lost answers, and refusals."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from afspm.model import RELAY_REQUEST, ControlRequest, ControlResponse, Note, Parameter, RelayedMessage
from afspm.testing.clients.bench import ClientBench
from afspm.testing.clients.checks.wire import ask, in_base64
from afspm.testing.clients.client_suite import client_check
from afspm.testing.clients.experiment import CLIENT, JUDGE, SCHEDULER, JudgedExperiment
from afspm.testing.clients.program import Answer, ClientProgram
from afspm.testing.clients.proxy import CuttingProxy
from afspm.testing.clients.scripted import ScriptedRequest, success
from afspm.testing.conformance import Lost, expect
from afspm.wire import decode, encode, encode_subject

REQUESTS = 1000
_AT_A_TIME = 16
_LONGEST = 12
"""The most chunks with replies that a connection delivers before it is cut."""
_TRY_S, _RETRIES = 0.3, 3
_SILENT_TRY_S = 2.0
"""A client reconnects after each silence, and gives up if that takes longer than all of its tries: 1.2 s were too short
for a client on a busy computer, which then repeated the request less often than the launch line says."""
_CUT_RETRIES = 100
"""Retries for 30 s: on a busy computer the scheduler may get no processor for 6 s."""
_ALL_S = 300.0
_SEEN_S = 10.0
_LOGGED_S = 60.0
"""Longest wait for thousands of log entries on a busy computer; an incomplete count would blame the client."""
_PARAMETER = "scan-speed"


@client_check(
    "requests/repeat",
    "A request without an answer is repeated with its id, as often as the launch line says.",
    "Keep the id with the request, not with the sending of it.",
)
def repeat(bench: ClientBench) -> None:
    with bench.scripted(request_timeout_s=_SILENT_TRY_S, request_retries=_RETRIES) as run:
        run.scheduler.reply = lambda request: []
        answer = ask(run, ControlRequest.RELEASE_CTRL)
        reply = (answer.get("response"), answer.get("detail"))
        expect(reply == ("REP_NO_RESPONSE", 2), "REP_NO_RESPONSE with the detail 2", str(answer))
        ids = [request.id for request in run.scheduler.requests]
        expect(len(set(ids)) == 1, "repetitions with the id of the first", f"the ids {sorted(set(ids))}")
        right = f"the request and {_RETRIES} repetitions, and perhaps some after a new connection"
        expect(1 + _RETRIES <= len(ids) <= 2 * (1 + _RETRIES), right, f"{len(ids)} requests")
        run.scheduler.reply = success
        expect(ask(run, ControlRequest.RELEASE_CTRL).ok, "the next request to be answered", "no success")


@client_check(
    "requests/other-answers",
    "The answer to another request is never taken for this one's.",
    "Compare the fourth frame with the id.",
)
def other_answers(bench: ClientBench) -> None:
    with bench.scripted() as run:
        earlier: list[ScriptedRequest] = []

        def late(request: ScriptedRequest) -> list[list[bytes]]:
            others = [replace(request, frames=(b"\7", b"", id_)) for id_ in (b"client/0/1", b"client/0/2")]
            refusals = [one.answered(ControlResponse.NOT_IN_CONTROL, b"", "late") for one in [*others, *earlier]]
            earlier.append(request)
            return [*refusals, request.answered()]

        run.scheduler.reply = late
        for _ in range(5):
            answer = ask(run, ControlRequest.RELEASE_CTRL)
            expect(answer.ok, "the success that has the request's id", str(answer))


def _note(experiment: JudgedExperiment, text: str) -> str:
    now_ns = experiment.clock.now_ns()
    note = Note(now_ns, "client", text, None, now_ns)
    return in_base64(encode_subject(RelayedMessage(*encode(note))))


def begin_read(client: ClientProgram) -> int:
    """Start the client's request for a parameter; return the step's id."""
    asked = encode_subject(Parameter(_PARAMETER))
    return client.begin("request", number=ControlRequest.PARAM, object=in_base64(asked))


def begin_note(experiment: JudgedExperiment, client: ClientProgram, text: str) -> int:
    """Start the client's publication of a note; return the step's id."""
    return client.begin("request", number=RELAY_REQUEST, object=_note(experiment, text))


def published(experiment: JudgedExperiment) -> Counter[str]:
    """Count the publications of each note."""
    notes = [decode("Note", packet.payload) for packet in experiment.packets("Note")]
    return Counter(note.text for note in notes)


def _executed(experiment: JudgedExperiment) -> int:
    def logged(who: str) -> int:
        logs = [decode("JournalEntries", packet.payload) for packet in experiment.packets("JournalEntries")]
        return sum((entry.who, entry.request) == (who, ControlRequest.PARAM) for log in logs for entry in log.entries)

    known = logged(JUDGE)
    experiment.scope.get(_PARAMETER)  # the log is in order: with this entry, all earlier ones are in it
    if not experiment.pump(lambda: logged(JUDGE) > known, _LOGGED_S):
        raise Lost(f"the scheduler's log of requests did not come within {_LOGGED_S:g} s")
    return logged(CLIENT)


@client_check(
    "requests/lost-replies",
    "Of 1,000 requests whose connection is cut again and again before the reply, each is executed once.",
    "Repeat with the same id after a reconnect, too.",
)
def lost_replies(bench: ClientBench) -> str:
    experiment = bench.experiment
    launch = experiment.launch
    assert launch.sockets.control is not None
    before, proxy = _executed(experiment), CuttingProxy(launch.sockets.control, _LONGEST)
    sockets = replace(launch.sockets, control=proxy.address)
    keys = {**(launch.keys or {})}
    keys["servers"] = {**keys["servers"], proxy.address: SCHEDULER}
    answers: list[Answer] = []
    try:
        with bench.client(
            experiment, sockets=sockets, keys=keys, request_timeout_s=_TRY_S, request_retries=_CUT_RETRIES
        ) as one:
            steps = [begin_read(one.program) for _ in range(_AT_A_TIME)]
            while steps:
                answers.append(one.program.answer(steps.pop(0), _ALL_S))
                if len(answers) + len(steps) < REQUESTS:
                    steps.append(begin_read(one.program))
    finally:
        proxy.close()
    expect(proxy.cuts > _LONGEST / 2, "connections that are cut", f"{proxy.cuts}")
    count = _executed(experiment) - before
    came = f"{count} that were executed, with {proxy.cuts} connections cut before a reply"
    expect(count == REQUESTS, f"{REQUESTS} requests, each executed once", came)
    for answer in answers:
        expect(answer.ok, "a success for each request, in the end", str(answer))
    return f"{proxy.cuts} connections were cut before a reply"


@client_check(
    "requests/restart",
    "A client that was killed and started again is not taken for its earlier life.",
    "Put something random into the life of `<name>/<run>-<life>/<number>`.",
)
def restart(bench: ClientBench) -> None:
    experiment = bench.experiment
    names = [f"life {life}" for life in range(3)]
    for name in names:
        with bench.client(experiment) as client:
            answer = client.program.answer(begin_note(experiment, client.program, name))
            expect(answer.ok, "a success", str(answer))
            executed = experiment.pump(lambda name=name: published(experiment)[name] > 0, _SEEN_S)  # type: ignore[misc]
            expect(executed, f"the first request of {name} to be executed", "the answer to one of an earlier life")


@client_check(
    "requests/refusals",
    "Refusals come with their response, reason and detail.",
    "Hand on all three frames.",
)
def refusals(bench: ClientBench) -> None:
    experiment = bench.experiment
    with bench.client(experiment) as client:
        program = client.program
        refused = [
            (program.do("action", name="start-scan"), "REP_NOT_IN_CONTROL"),
            (program.do("set_parameter", name="tip-bias-voltage", value="1", unit="V"), "REP_NOT_IN_CONTROL"),
            (program.do("get_parameter", name="x-no-such-thing"), "REP_PARAM_NOT_SUPPORTED"),
        ]
        program.succeed("request_control", problem=0, timeout_s=10.0)
        refused += [
            (program.do("action", name="x-no-such-thing"), "REP_ACTION_NOT_SUPPORTED"),
            (program.do("set_parameter", name="tip-bias-voltage", value="5", unit="V"), "REP_PARAM_ERROR"),
            (program.do("set_parameter", name="tip-bias-voltage", value="5", unit="kg"), "REP_PARAM_ERROR"),
            (
                program.do("request", number=ControlRequest.REQUEST_CTRL, object=in_base64(b"\4")),
                "REP_WRONG_EXP_PROBLEM",
            ),
        ]
        for answer, response in refused:
            reply = answer.get("response")
            expect(not answer.ok and reply == response, f"the refusal {response}", str(answer))
            expect(answer.get("reason"), f"the reason of {response}", str(answer))
        program.succeed("release_control")
