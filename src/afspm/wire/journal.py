"""What happens beside what is measured, to and from the messages of the contract."""

from __future__ import annotations

from collections.abc import Iterable

from afspm import model
from afspm.errors import WireError
from afspm.wire.convert import known, time_ns, timestamp
from afspm.wire.generated import control_pb2, journal_pb2
from afspm.wire.messages import parse

Buffer = bytes | memoryview


def entries_to_wire(entries: model.JournalEntries) -> journal_pb2.JournalEntries:
    message = journal_pb2.JournalEntries()
    for entry in entries.entries:
        message.entries.add(
            timestamp=timestamp(entry.time_ns),
            kind=entry.kind,
            who=entry.who,
            what=entry.what,
            response=entry.response,
            reason=entry.reason or None,
            took=entry.took_s,
            event=journal_pb2.ControlEvent.ValueType(entry.event) if entry.event else None,
            request=entry.request,
            problem=entry.problem,
            mode=control_pb2.ControlMode.ValueType(entry.mode) if entry.mode else None,
            late=entry.late or None,
        )
    return message


def entries_from_wire(payload: Buffer) -> model.JournalEntries:
    message = parse(journal_pb2.JournalEntries, payload)
    return model.JournalEntries(
        tuple(
            model.JournalEntry(
                time_ns(entry.timestamp),
                entry.kind,
                entry.who,
                entry.what,
                entry.response if entry.HasField("response") else None,
                entry.reason,
                entry.took if entry.HasField("took") else None,
                known(model.ControlEvent, entry.event),
                entry.request if entry.HasField("request") else None,
                entry.problem if entry.HasField("problem") else None,
                known(model.ControlMode, entry.mode) if entry.HasField("mode") else None,
                entry.late,
            )
            for entry in message.entries
        )
    )


def processes_to_wire(states: model.ProcessStates) -> journal_pb2.ProcessStates:
    message = journal_pb2.ProcessStates(timestamp=timestamp(states.time_ns), supervisor=states.supervisor)
    for state in states.processes:
        message.processes.add(
            name=state.name,
            role=state.role,
            condition=journal_pb2.ProcessCondition.ValueType(int(state.condition)),
            since=timestamp(state.since_ns),
            step_age=state.step_age_s,
            starts=state.starts,
            pid=state.pid,
            last_exit=state.last_exit,
        )
    return message


def processes_from_wire(payload: Buffer) -> model.ProcessStates:
    message = parse(journal_pb2.ProcessStates, payload)
    return model.ProcessStates(
        time_ns(message.timestamp),
        message.supervisor,
        tuple(
            model.ProcessState(
                state.name,
                state.role,
                known(model.ProcessCondition, state.condition),
                time_ns(state.since),
                state.step_age,
                state.starts,
                state.pid,
                state.last_exit,
            )
            for state in message.processes
        ),
    )


def log_to_wire(log: model.LogLines) -> journal_pb2.LogLines:
    message = journal_pb2.LogLines()
    for line in log.lines:
        message.lines.add(timestamp=timestamp(line.time_ns), name=line.name, level=line.level, text=line.text)
    return message


def log_from_wire(payload: Buffer) -> model.LogLines:
    message = parse(journal_pb2.LogLines, payload)
    return model.LogLines(
        tuple(model.LogLine(time_ns(line.timestamp), line.name, line.level, line.text) for line in message.lines)
    )


def progress_to_wire(progress: model.Progress) -> journal_pb2.Progress:
    return journal_pb2.Progress(
        timestamp=timestamp(progress.time_ns),
        name=progress.name,
        done=progress.done,
        of=progress.of,
        remaining=progress.left_s,
    )


def progress_from_wire(payload: Buffer) -> model.Progress:
    message = parse(journal_pb2.Progress, payload)
    left_s = message.remaining if message.HasField("remaining") else None
    return model.Progress(time_ns(message.timestamp), message.name, message.done, message.of, left_s)


def told_to_wire(told: model.RelayedMessage) -> journal_pb2.Told:
    return journal_pb2.Told(message=told.message, payload=told.payload)


def told_from_wire(payload: Buffer) -> model.RelayedMessage:
    """Raises WireError: it names no message."""
    message = parse(journal_pb2.Told, payload)
    if not message.message:
        raise WireError("nothing is told: the name of the message is missing")
    return model.RelayedMessage(message.message, message.payload)


def encode_orders(restart: Iterable[str]) -> bytes:
    """The object of the answer to TELL_REQUEST."""
    return journal_pb2.Orders(restart=restart).SerializeToString()


def decode_orders(payload: Buffer) -> tuple[str, ...]:
    """Processes that are to be started anew. Raises WireError: the bytes are no orders."""
    return tuple(parse(journal_pb2.Orders, payload).restart)
