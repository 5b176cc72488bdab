"""Messages of a component's own type, read from a record by a process that has not the types' package."""

from __future__ import annotations

import csv
import json
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from declared_messages import forget_afterwards
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.timestamp_pb2 import DESCRIPTOR as TIMESTAMP_FILE
from record_lab import START_NS, Night

from afspm import wire
from afspm.night.notes import append_note
from afspm.night.run import open_run
from afspm.plugins.web.dashboard.content import messages_html
from afspm.plugins.web.dashboard.night import Night as RecordedNight
from afspm.plugins.web.dashboard.night import NightWatch
from afspm.record.store import RecordSettings, RecordStore
from afspm.report.export import export
from afspm.report.night_report import write
from afspm.supervisor.own_runs import register_own_messages
from afspm.wire import described_types

POWER = "power_w: 0.0084, at: 2026-03-14T20:00:00Z, image: 4000 bytes, trace: [0, 1, 2, 3, 4, 5, 6, 7, … 900 values]"
UNREAD = (
    "2 messages LaserPower_laser can't be read: this record does not describe the type, and laser_messages is not "
    "imported"
)


def laser_power() -> Any:
    """Return a new class of a message with a number of imprecise binary value, a time, an image and a long list."""
    file = FileDescriptorProto(
        name="laser.proto", package="my_lab", syntax="proto3", dependency=["google/protobuf/timestamp.proto"]
    )
    kinds = FieldDescriptorProto
    message = file.message_type.add(name="LaserPower")
    once, many = kinds.LABEL_OPTIONAL, kinds.LABEL_REPEATED
    message.field.add(name="power_w", number=1, type=kinds.TYPE_DOUBLE, label=once)
    at = ".google.protobuf.Timestamp"
    message.field.add(name="at", number=2, type=kinds.TYPE_MESSAGE, type_name=at, label=once)
    message.field.add(name="image", number=3, type=kinds.TYPE_BYTES, label=once)
    message.field.add(name="trace", number=4, type=kinds.TYPE_DOUBLE, label=many)
    pool = DescriptorPool()
    pool.AddSerializedFile(TIMESTAMP_FILE.serialized_pb)
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("my_lab.LaserPower"))


@pytest.fixture(params=[True, False], ids=["described", "of an older afspm"])
def is_described(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture
def run(is_described: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a run with two messages, which this process does not know any more."""
    with monkeypatch.context() as of_the_run:
        forget_afterwards(of_the_run)
        kind = laser_power()
        wire.declare(wire.MessageDeclaration(type=kind, relayed=True))
        night = Night()
        settings = RecordSettings({"experiment": "night"}, messages=described_types.describe() if is_described else {})
        with closing(RecordStore(tmp_path, settings)) as store:
            store.take([night.control()])
            for power_w in (0.1, 0.0084000000000000012):
                message = kind(power_w=power_w, image=bytes(4000), trace=range(900))
                message.at.FromNanoseconds(START_NS)
                store.take([night.packet(message, "LaserPower_laser")])
    (tmp_path / "run.json").write_text(json.dumps({"guest": {"name": "guest", "messages": ["laser_messages"]}}))
    assert "LaserPower" not in wire.known_messages()
    return tmp_path


def test_report_shows_own_messages_also_after_a_later_note(run: Path, is_described: bool) -> None:  # contributors K2
    append_note(run, "Ada", "the laser drifts", START_NS)
    html = write(run).read_text(encoding="utf-8").replace("&#x27;", "'")
    assert "Messages of components" in html
    assert (POWER in html) is is_described
    assert (UNREAD in html) is not is_described


def test_page_of_a_past_run_shows_own_messages_at_each_moment(run: Path, is_described: bool) -> None:  # contributors K2
    watch = NightWatch(RecordedNight(run))
    assert (POWER if is_described else UNREAD) in messages_html(watch.overview).replace("&#x27;", "'")
    if is_described:
        watch.go(START_NS + 2_000_000)
        assert "power_w: 0.1," in messages_html(watch.overview)


def test_own_messages_are_read_from_the_record_and_exported(run: Path, is_described: bool, tmp_path: Path) -> None:
    with open_run(run) as record:
        read = [message.power_w for _, _, message in record.messages(["LaserPower"])]
        assert record.unread_messages() == ([] if is_described else [UNREAD])
        files = {file.name: file for file in export(record, "csv", tmp_path / "csv")}
    assert read == ([0.1, 0.0084000000000000012] if is_described else [])
    assert ("message-LaserPower.csv" in files) is is_described
    if is_described:
        first, _ = csv.DictReader(files["message-LaserPower.csv"].read_text(encoding="utf-8").splitlines())
        assert (first["component"], first["power_w"]) == ("laser", "0.1")


def test_own_messages_of_a_received_run_are_registered_from_its_record(
    run: Path, is_described: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:  # contributors K2
    forget_afterwards(monkeypatch)
    register_own_messages(run, ["laser_messages"])
    assert wire.is_relayed("LaserPower") is is_described
    assert ("messages of laser_messages are not read" in caplog.text) is not is_described


def test_description_in_a_record_replaces_no_message_of_afspm(monkeypatch: pytest.MonkeyPatch) -> None:
    forget_afterwards(monkeypatch)
    wire.declare(wire.MessageDeclaration(type=laser_power()))
    foreign: Any = described_types.describe()
    foreign["types"] = {"ControlState": "my_lab.LaserPower"}
    assert described_types.read(foreign) == {}


@pytest.mark.parametrize("damaged", [{"files": ["AAAA"], "types": {"Own": "Own"}}, {"files": 1}, [], "text"])
def test_damaged_description_of_messages_describes_nothing(damaged: Any) -> None:
    assert described_types.read(damaged) == {}


def test_text_of_a_message_with_an_impossible_time_is_shown() -> None:
    power = laser_power()()
    power.at.seconds = 10**12
    assert wire.as_text(power) == "at { seconds: 1000000000000 }"


def test_text_of_a_message_has_fields_of_value_zero() -> None:
    text = wire.as_text(laser_power()(trace=[1e-9] * 3, image=bytes(1)))
    assert text == "power_w: 0, image: 1 byte, trace: [1e-09, 1e-09, 1e-09]"
