"""Messages of a component's own type on the page: in the run, and after it, when their module is gone."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from declared_messages import forget_afterwards
from tests.ui.ui_lab import DEADLINE_S, Night, Opened

import afspm

MODULE = """
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field, FileDescriptorProto
from google.protobuf.descriptor_pool import Default
from google.protobuf.message_factory import GetMessageClass

from afspm.wire import MessageDeclaration

file = FileDescriptorProto(name="laser.proto", package="my_lab", syntax="proto3")
message = file.message_type.add(name="LaserPower")
message.field.add(name="power_w", number=1, type=Field.TYPE_DOUBLE, label=Field.LABEL_OPTIONAL)
message.field.add(name="remark", number=2, type=Field.TYPE_STRING, label=Field.LABEL_OPTIONAL)
message.field.add(name="image", number=3, type=Field.TYPE_BYTES, label=Field.LABEL_OPTIONAL)
Default().Add(file)
LaserPower = GetMessageClass(Default().FindMessageTypeByName("my_lab.LaserPower"))
LASER_POWER = MessageDeclaration(type=LaserPower, relayed=True)
"""
COMPONENT = """
from afspm import Component
from laser_messages import LaserPower


class Laser(Component):
    publishes = ("LaserPower",)

    def on_scan(self, scan):
        self.publish(LaserPower(power_w=3 * 0.0028, remark="<b>warm</b>", image=bytes(4096)))
"""
MORE = """
[laser]
component = true
class = "laser.Laser"
"""
SHOWN = "power_w: 0.0084, remark: <b>warm</b>, image: 4096 bytes"


def test_own_messages_are_on_the_page_in_the_run_and_after_it(
    tmp_path: Path, opened: Opened, keep: Callable[[Any, str], None], monkeypatch: pytest.MonkeyPatch
) -> None:  # contributors K2
    forget_afterwards(monkeypatch)
    (tmp_path / "laser_messages.py").write_text(MODULE)
    (tmp_path / "laser.py").write_text(COMPONENT)
    night = Night(tmp_path, speed=600.0, more=MORE, messages=("laser_messages",), options=("--stay",), every="4000 h")
    try:
        page = opened(night.url, width=1440, height=1800)
        page.wait_for_selector(f".messages li:has-text('{SHOWN}')")
        keep(page, "own-messages")
        (tmp_path / "laser_messages.py").unlink()
        with afspm.connect(night.folder, "tester", messages=()) as scope:
            scope.end_experiment()
        night.wait_for(r"the dashboard is at \S+; press Ctrl-C to close it")
        after = opened(night.url, person="Ada", width=1440, height=1800)
        after.wait_for_function("window.afspm?.scrubber", timeout=DEADLINE_S * 1000)
        after.wait_for_selector(f".messages li:has-text('{SHOWN}')")
        keep(after, "own-messages-recorded")
        night.process.send_signal(signal.SIGINT)
        assert night.process.wait(DEADLINE_S) == 0
        assert "power_w: 0.0084" in (night.folder / "report.html").read_text(encoding="utf-8")
    finally:
        night.close()
