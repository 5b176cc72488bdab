"""A translator of an emulator connects to the emulator of its own run only."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from afspm.basics.errors import ConfigError
from afspm.basics.launch import Launch
from afspm.translator.driver_base import ControllerLost
from afspm.translator.emulated_controller import AddressNotice, EmulatedController, notice_file, wired_to

RUN = "0123456789abcdef"
TELLS = """
import sys
from pathlib import Path
from afspm.translator.emulated_controller import AddressNotice
notice = AddressNotice(Path(sys.argv[1]), sys.argv[2])
notice.tell("127.0.0.1:1234")
print("told", flush=True)
sys.stdin.read()
"""


class Vendor:
    """The part of a driver that is used here."""

    def __init__(self, controller_at: str = "127.0.0.1:6501") -> None:
        self.controller_at = controller_at
        self.connected: list[str] = []
        self.at_connect: Any = lambda: None

    def connect(self) -> None:
        self.at_connect()
        self.connected.append(self.controller_at)

    def close(self) -> None:
        self.connected.append("closed")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return notice_file(str(tmp_path), "controller")


@pytest.fixture
def notice(file: Path) -> Iterator[AddressNotice]:
    with closing(AddressNotice(file, RUN)) as made:
        yield made


def reach(file: Path, vendor: Vendor, run: str = RUN) -> EmulatedController:
    found = EmulatedController("controller", file, run)
    found.reach(vendor)  # type: ignore[arg-type]
    return found


def test_translator_connects_to_the_emulator_instead_of_the_address_in_the_settings(
    file: Path, notice: AddressNotice
) -> None:
    notice.tell("127.0.0.1:40001")
    vendor = Vendor()
    reach(file, vendor).prove()
    assert vendor.connected == ["127.0.0.1:40001"]


def test_translator_connects_only_once_the_emulator_listens(file: Path) -> None:
    vendor = Vendor()
    with pytest.raises(ControllerLost, match="not started"):
        reach(file, vendor)
    with closing(AddressNotice(file, RUN)), pytest.raises(ControllerLost, match="is not listening"):
        reach(file, vendor)
    assert vendor.connected == []


def test_address_of_a_killed_emulator_is_not_used(file: Path) -> None:
    command = [sys.executable, "-c", TELLS, str(file), RUN]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as emulator:
        assert emulator.stdout is not None
        assert emulator.stdout.readline().strip() == b"told"
        vendor = Vendor()
        reached = reach(file, vendor)
        emulator.kill()
        emulator.wait()
        with pytest.raises(ControllerLost, match="is not running"):
            reached.prove()
        with pytest.raises(ControllerLost, match="is not running"):
            reach(file, vendor)
    assert vendor.connected == ["127.0.0.1:1234"]


def test_emulator_of_another_run_is_not_used(file: Path) -> None:
    vendor = Vendor()
    with closing(AddressNotice(file, "another")) as notice:
        notice.tell("127.0.0.1:40001")
        with pytest.raises(ControllerLost, match="another run"):
            reach(file, vendor)
    assert vendor.connected == []


def test_emulator_that_closed_its_address_fails_the_proof_until_reconnected(file: Path, notice: AddressNotice) -> None:
    notice.tell("127.0.0.1:40001")
    reached = reach(file, Vendor())
    notice.tell("")
    with pytest.raises(ControllerLost, match="is not listening"):
        reached.prove()
    notice.tell("127.0.0.1:40001")
    with pytest.raises(ControllerLost, match="was restarted"):
        reached.prove()


def test_a_connection_that_was_made_while_the_emulator_changed_is_closed(file: Path, notice: AddressNotice) -> None:
    notice.tell("127.0.0.1:40001")
    vendor = Vendor()
    vendor.at_connect = lambda: notice.tell("127.0.0.1:40002")
    with pytest.raises(ControllerLost, match="was restarted"):
        reach(file, vendor)
    assert vendor.connected == ["127.0.0.1:40001", "closed"]


def test_simulated_experiment_commands_no_unproved_controller() -> None:
    with pytest.raises(ConfigError, match="nothing proves"):
        wired_to(Launch("microscope", simulated=True), Vendor())  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="has no controller_at"):
        wired_to(Launch("m", controller="c", run=RUN, state_dir="."), Vendor(""))  # type: ignore[arg-type]
    assert wired_to(Launch("microscope", simulated=True), Vendor("")) is None  # type: ignore[arg-type]
    assert wired_to(Launch("microscope"), Vendor()) is None  # type: ignore[arg-type]
