"""The common behaviour of all emulated controllers: start, stop, crash, names."""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from deadlines import DEADLINE_S
from fake_clock import FakeClock

from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import ConfigError, TransportError
from afspm.emulation import Faults, SimulatedInstrument
from afspm.plugins.asylum.emulator import AsylumEmulator
from afspm.plugins.park.emulator.smartscan import SmartScanProgram
from afspm.simulation.emulation.emulator import Emulator, emulator_names, find_emulator

from .tiny import Tiny, ask


def test_emulator_answers_in_the_block_and_is_gone_after_it(tmp_path: Path) -> None:
    with Tiny(port=0).running(tmp_path) as address:
        assert ask(address, "hello") == ["1"]
    with pytest.raises(OSError):  # noqa: PT011 - each system refuses in words of its own
        ask(address, "hello")


def test_emulator_can_be_run_again(tmp_path: Path) -> None:
    tiny = Tiny(port=0)
    for _ in range(2):
        with tiny.running(tmp_path) as address:
            assert ask(address, "hello") == ["1"]


def test_activity_ends_at_its_time_without_a_request(tmp_path: Path) -> None:
    written = threading.Event()

    class Telling(Tiny):
        def tick(self, now_s: float) -> float | None:
            super().tick(now_s)
            if self.ended:
                written.set()
            return None

    tiny = Telling(port=0)
    # a scan of 20 experiment seconds: 20 ms
    with tiny.running(tmp_path, ExperimentClock.starting_now(0.0, speed=1000.0)) as address:
        assert ask(address, "scan") == ["1 scan"]
        assert written.wait(DEADLINE_S)
    assert (tmp_path / "scan.txt").exists()
    assert tiny.rig.scan is not None
    assert tiny.ended[0] >= tiny.rig.scan.end_s


class WithButton(Tiny):
    """Shows a button while it listens, and another one once that is pressed."""

    def open(self) -> str:
        self.pressed = threading.Event()
        self.show_button("press-OK", "a dialog waits", self._press)
        return super().open()

    def _press(self) -> None:
        self.pressed.set()
        self.show_button("press-again", "another dialog waits", self._fail)

    def _fail(self) -> None:
        raise ValueError("what the button does fails")


def until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline_s
        threading.Event().wait(0.01)


def test_button_of_the_screen_is_pressed_by_deleting_its_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    button, again = (tmp_path / f"delete-to-press-{name}.txt" for name in ("OK", "again"))
    emulated = WithButton(port=0)
    with emulated.running(tmp_path) as address:
        assert "a dialog waits" in button.read_text(encoding="utf-8")
        assert ask(address, "hello") == ["1"]
        assert not emulated.pressed.is_set()
        button.unlink()
        until(again.exists)
        assert emulated.pressed.is_set()
        assert not button.exists()
        again.unlink()
        until(lambda: "what the button does fails" in caplog.text)
        assert ask(address, "hello") == ["1"], "an error behind a button ends nothing else"
    assert f"delete {button} to press the button" in caplog.text


def test_button_is_gone_when_the_controller_ends(tmp_path: Path) -> None:
    with WithButton(port=0).running(tmp_path):
        assert list(tmp_path.glob("delete-to-*"))
    assert not list(tmp_path.glob("delete-to-*"))


def test_emulated_crash_closes_the_connection_without_an_answer(tmp_path: Path) -> None:
    with Tiny(port=0, faults=["crash"]).running(tmp_path) as address:
        assert ask(address, "hello") == [""]


def test_port_that_is_taken_is_an_error_of_the_block(tmp_path: Path) -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        pytest.raises(TransportError, match="another program listens"),
        Tiny(port=taken.getsockname()[1]).running(tmp_path),
    ):
        pytest.fail("it listens on a taken port")


def test_vendors_usual_port_is_taken_on_request_alone() -> None:
    assert (Tiny().port, Tiny(**Tiny.usual).port) == (0, 45997)


def test_invalid_settings_are_refused_before_the_start() -> None:
    with pytest.raises(ConfigError, match="velocitty"):
        Tiny(drift={"velocitty": 1.0}).check()
    with pytest.raises(ConfigError, match="no fault 'crush'"):
        Tiny(faults=["crush"]).check()
    with pytest.raises(ConfigError, match="unknown: 'frequency-shift'"):
        AsylumEmulator(feedback={"mode": "frequency-shift", "setpoint": -20.0}).check()


def test_emulator_is_found_by_short_name_or_by_module() -> None:
    assert find_emulator(f"{Tiny.__module__}.Tiny") is Tiny
    with pytest.raises(ConfigError, match="there is no emulator 'veeco'"):
        find_emulator("veeco")
    with pytest.raises(ConfigError, match="is not an emulator"):
        find_emulator("pathlib.Path")


@pytest.mark.parametrize("name", emulator_names())
def test_emulators_of_afspm_declare_their_vendor(name: str) -> None:
    found = find_emulator(name)
    assert issubclass(found, Emulator)
    assert found.vendor
    assert all(found.fault_kinds.values())


def test_unexpected_error_ends_the_activity_and_not_the_emulator(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    class Clumsy(Tiny):
        def _answer(self, asked: str) -> None:
            super()._answer(asked)
            if asked == "scan":
                raise ZeroDivisionError("of a request")

        def tick(self, now_s: float) -> float | None:
            scan = self.rig.scan
            if scan is not None and scan.stopped_s is not None and not self.ended:
                self.ended.append(scan.stopped_s)
                raise ZeroDivisionError("of the end of a scan")
            return None

    clumsy = Clumsy(port=0)
    with clumsy.running(tmp_path) as address:
        assert ask(address, "scan", "hello") == ["1 scan", "1"]
    assert [record.exc_info[1].args[0] for record in caplog.records if record.exc_info] == [  # type: ignore[union-attr]
        "of a request",
        "of the end of a scan",
    ]


def test_program_refuses_an_emulator_that_does_not_declare_its_faults(tmp_path: Path) -> None:
    faults = Faults([], {"stopped": "a scan is stopped", "crash": "it vanishes"}, 0.0)
    rig = SimulatedInstrument({}, seed=3, start_s=0.0)
    with pytest.raises(TypeError, match=r"lack scan-refused, spectrum-refused, withdrawn, .*add \*\*MakerProgram"):
        SmartScanProgram(rig, faults, FakeClock(), tmp_path, logging.getLogger("test"), start_s=0.1, file_s=0.1)
