"""A message is declared once, and everything else follows from its declaration."""

from __future__ import annotations

import ast
import json
import logging
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from declared_messages import forget_afterwards
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

import afspm
from afspm import wire
from afspm.basics.errors import ConfigError, InvalidValue
from afspm.client.component import Component
from afspm.client.dispatch import MessageDispatcher
from afspm.client.experiment_link import PublishedState
from afspm.model import Packet, PacketHeader, ProblemNames, Role
from afspm.night.overview import Overview
from afspm.night.run import open_run
from afspm.plugins.web.gateway.events import EventHistory
from afspm.plugins.web.gateway.models import event_kinds
from afspm.record.journal import SCHEDULER
from afspm.record.store import RecordSettings, RecordStore
from afspm.scheduler.publishing.cache import PacketCache
from afspm.wire import MessageDeclaration, MessageKind
from afspm.wire.message_types import register_all

SOURCES = Path(afspm.__file__).parent
FEWEST = 3


def message_class(name: str, package: str = "lab") -> Any:
    file = descriptor_pb2.FileDescriptorProto(name=f"{package}/{name}.proto", package=package, syntax="proto3")
    message = file.message_type.add(name=name)
    message.field.add(name="tilt_rad", number=1, type=1, label=1)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{package}.{name}"))


@pytest.fixture
def tilt(monkeypatch: pytest.MonkeyPatch) -> MessageDeclaration:
    """Declare a message that is not built in."""
    forget_afterwards(monkeypatch)
    return wire.declare(
        MessageDeclaration(
            type=message_class("StageTilt"),
            kind=MessageKind.STATE,
            source=Role.SCHEDULER,
            history=3,
            handler="on_tilt",
            attribute="tilt",
            event="tilt",
            in_past=True,
        )
    )


def packet(declaration: MessageDeclaration, number: int) -> Packet:
    name, payload = wire.encode(declaration.type(tilt_rad=0.5 * number))
    return Packet(name, payload, number)


def test_a_declared_message_reaches_the_handler_of_a_component(tilt: MessageDeclaration) -> None:
    received = []

    class Watcher(Component):
        def on_tilt(self, message: Any) -> None:
            received.append(message.tilt_rad)

    dispatcher = MessageDispatcher(Watcher(), Component, None, logging.getLogger("watcher"))
    assert dispatcher.wants(packet(tilt, 1))
    dispatcher.give(packet(tilt, 1), PublishedState())
    assert received == [0.5]


def test_a_declared_state_is_followed_by_every_client(tilt: MessageDeclaration) -> None:
    assert tilt.name in wire.followed_messages()
    assert tilt.name in wire.messages_without_values()
    view = PublishedState()
    view.take(tilt.name, wire.decode(tilt.name, packet(tilt, 2).payload))
    assert (view.tilt.tilt_rad, view.count(tilt.name)) == (1.0, 1)  # type: ignore[attr-defined]


def test_the_cache_keeps_as_many_of_a_message_as_its_declaration_says(tilt: MessageDeclaration) -> None:
    cache = PacketCache()
    for number in range(1, 6):
        taken = cache.take(packet(tilt, number * 1_000_000), PacketHeader(tilt.name), number * 1_000_000)
        assert taken is not None
        assert taken[1] == 3
    assert [one.packet.time_ns for one in cache] == [3_000_000, 4_000_000, 5_000_000]
    assert cache.stamp(tilt.name, b"", 9_000_000)[1] == 3


def test_a_declared_message_is_streamed_by_the_gateway_under_its_kind(tilt: MessageDeclaration) -> None:
    history = EventHistory(ProblemNames())
    history.take(tilt.name, wire.decode(tilt.name, packet(tilt, 1).payload), 1)
    (event,) = history.after(0, {"tilt"}, 10).events
    assert event.kind == "tilt"
    assert "tilt" in event_kinds()
    assert json.loads(event.text)["data"] == {"tilt_rad": 0.5}


def test_a_declared_message_comes_back_from_the_record(tilt: MessageDeclaration, tmp_path: Path) -> None:
    seen = []

    class TiltOverview(Overview):
        def _on_tilt(self, message: Any, time_ns: int) -> None:
            seen.append((message.tilt_rad, time_ns))

    store = RecordStore(tmp_path, RecordSettings({"experiment": "tilts"}))
    store.take([(packet(tilt, 1), SCHEDULER), (packet(tilt, 2), SCHEDULER)])
    store.close()
    in_past = [one.name for one in wire.declared() if one.in_past]
    overview = TiltOverview()
    with open_run(tmp_path) as run:
        for recorded, name, thing in run.messages(in_past):
            overview.take(name, thing, recorded.time_ns or 0, recorded.envelope)
    assert seen == [(0.5, 1), (1.0, 2)]


def test_a_module_of_the_user_declares_its_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("lab_level")
    forget_afterwards(monkeypatch)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    with pytest.raises(ConfigError, match="holds no message types"):
        register_all([module.__name__])
    vars(module)["LEVEL"] = MessageDeclaration(type=message_class("StageLevel"), history=7)
    register_all([module.__name__])
    assert wire.declaration("StageLevel").history == 7


def test_a_message_cannot_be_declared_in_two_ways(tilt: MessageDeclaration) -> None:
    assert wire.declare(tilt) is tilt
    assert wire.register(tilt.type) is tilt.type
    assert wire.declaration(tilt.name) is tilt
    with pytest.raises(InvalidValue, match="'StageTilt' is declared differently"):
        wire.declare(MessageDeclaration(type=tilt.type, history=4))
    with pytest.raises(InvalidValue, match="a message 'StageTilt' already"):
        wire.declare(MessageDeclaration(type=message_class("StageTilt", "other_lab")))


def test_messages_about_processes_requests_and_logs_are_not_of_the_experiment() -> None:
    beside = set(wire.known_messages()) - set(wire.messages_of_the_experiment())
    assert {"JournalEntries", "LogLines", "ProcessStates", "Progress"} <= beside
    assert {"Scan2d", "Spec1d", "ControlState", "DriftMapping", "ScanLines"} <= set(wire.messages_of_the_experiment())


def test_no_prefix_of_the_experiment_matches_a_message_beside_it() -> None:
    of_it = wire.messages_of_the_experiment()
    assert not [name for name in set(wire.known_messages()) - set(of_it) if name.startswith(of_it)]


def handmade_lists(source: str) -> list[tuple[int, list[str]]]:
    """Return (line, names) of each set, table, list or tuple in which three or more messages stand by name.

    A component's own `listens` is its choice, and `__all__` names classes.
    """
    known, chosen = set(wire.known_messages()), set[ast.AST]()
    if sum(source.count(f'"{name}"') for name in known) < FEWEST:  # parsing all sources takes seconds
        return []
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(isinstance(one, ast.Name) and one.id in ("listens", "__all__") for one in targets):
                chosen.update(ast.walk(node))
    found = []
    for node in ast.walk(tree):
        if node in chosen or not isinstance(node, ast.Set | ast.Tuple | ast.List | ast.Dict):
            continue
        parts = [*node.keys, *node.values] if isinstance(node, ast.Dict) else node.elts
        names = [one.value for one in parts if isinstance(one, ast.Constant) and one.value in known]
        if len(names) >= FEWEST:
            found.append((node.lineno, names))
    return found


def test_no_list_of_messages_is_kept_by_hand() -> None:
    found = {
        f"{path.relative_to(SOURCES)}:{line}": names
        for path in sorted(SOURCES.rglob("*.py"))
        if "wire" not in path.relative_to(SOURCES).parts
        for line, names in handmade_lists(path.read_text(encoding="utf-8"))
    }
    assert not found, "derive these from wire.declared()"


def test_a_list_of_messages_kept_by_hand_is_found() -> None:
    assert handmade_lists('KEPT = {"Scan2d": 5, "Spec1d": 10, "Note": 1000}') == [(1, ["Scan2d", "Spec1d", "Note"])]
    assert handmade_lists('PAST = ("Scan2d", "Note",\n        "LogLines")') == [(1, ["Scan2d", "Note", "LogLines"])]
    assert not handmade_lists('class Own(Component):\n    listens: ClassVar = ("Scan2d", "Note", "LogLines")')
    assert not handmade_lists('BOTH = ("Scan2d", "Spec1d")')
