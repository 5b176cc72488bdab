"""One run at a time commands a controller."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import BinaryIO

import pytest
from deadlines import DEADLINE_S

from afspm.basics.clock import ExperimentClock
from afspm.basics.exit_codes import ExitCode
from afspm.basics.file_lock import lock
from afspm.basics.launch import Launch, Sockets
from afspm.plugins.asylum import Asylum
from afspm.plugins.gxsm import Gxsm
from afspm.plugins.nanonis import Nanonis
from afspm.plugins.nanonis.shadow import NanonisShadow
from afspm.plugins.nanosurf import Nanosurf
from afspm.plugins.park import Park
from afspm.simulation.simulator import Simulator
from afspm.translator import controller_lock, translator
from afspm.translator.controller_lock import ControllerTaken, commanding
from afspm.translator.translator import run_translator
from afspm.transport.process.context import ProcessActivity, ProcessContext

DIES_HOLDING = """
import os, sys
from afspm.translator import controller_lock
controller_lock._COMMON = sys.argv[2]
with controller_lock.commanding(sys.argv[1], "runs/the-dead"):
    os._exit(1)
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the locks."""
    monkeypatch.setattr(controller_lock, "_COMMON", str(tmp_path))
    return tmp_path / "afspm-controllers"


@pytest.mark.parametrize("other", ["lab-1:6501", " LAB-1:6503, 6504", "tcp://lab-1:5555/x", "[lab-1]:6502,6501"])
def test_second_run_is_refused_with_the_name_of_the_first(other: str) -> None:
    with commanding("lab-1:6501", "runs/first"):
        with (
            pytest.raises(ControllerTaken, match=f"commands this controller: runs/first, process {os.getpid()}"),
            commanding(other, "b"),
        ):
            pass
        with commanding("lab-2:6501", "runs/second") as take:
            take("session folder D:")
        with commanding("lab-3:6501", "runs/third") as take:
            take("session folder D:")  # of another computer
    with commanding(other, "runs/second"):
        pass


@pytest.mark.skipif(sys.platform == "win32", reason="an open file can't be removed there")
def test_lock_file_is_removed_and_a_removed_one_is_never_held(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Path] = []
    locked = lock

    def lock_too_late(file: BinaryIO) -> None:
        # its former holder deletes the file right after it was opened
        if not opened:
            opened.extend(folder.iterdir())
            opened[0].unlink()
        locked(file)

    monkeypatch.setattr(controller_lock, "lock", lock_too_late)
    with (
        commanding("lab:1", "a"),
        pytest.raises(ControllerTaken, match="commands this controller: a"),
        commanding("lab:1", "b"),
    ):
        pass
    assert opened
    assert not list(folder.iterdir())


@pytest.mark.parametrize(
    "other", ["localhost:6502,6501", "127.1 : 6501", "tcp://LOCALHOST:6501", "[::1]:6501", "NAME:6501"]
)
def test_this_computer_is_the_same_by_each_name_and_number(other: str) -> None:
    # reports B1
    if "::1" in other and not controller_lock._is_here(socket.AF_INET6, ("::1", 0)):
        pytest.skip("this computer has no IPv6")
    if "NAME" in other:
        other = other.replace("NAME", socket.gethostname())
        if not controller_lock._names(other)[0]:
            pytest.skip("the name of this computer is unknown to it")
    with commanding("127.0.0.1:6501", "a"):
        with pytest.raises(ControllerTaken), commanding(other, "b"):
            pass
        with commanding("localhost:6502,6503", "c"):
            pass


def test_one_controller_of_this_computer_is_known_by_its_own_words_at_all_its_ports() -> None:
    # reports B1
    with commanding("localhost:6501,6502", "runs/first") as take:
        take("session folder D:")
        take("session folder D:")  # once more after a lost connection
        with commanding("localhost:6503,6504", "b") as take_other:
            take_other("")
            with pytest.raises(ControllerTaken, match="runs/first, process"):
                take_other("session folder D:")
            take_other("session folder E:")
            take_other("session folder D:")  # chosen by a person meanwhile: a lost controller is reached again
        with commanding("", "a shadow") as take_nothing:
            take_nothing("session folder D:")
    with commanding("shm", "a") as take:
        take("session folder D:")


def test_a_run_that_failed_or_was_killed_leaves_nothing_locked(tmp_path: Path, folder: Path) -> None:
    with contextlib.suppress(ZeroDivisionError), commanding("lab:1", "a"):
        raise ZeroDivisionError
    died = subprocess.run([sys.executable, "-c", DIES_HOLDING, "lab:1", str(tmp_path)], check=False, timeout=DEADLINE_S)
    assert died.returncode == 1
    assert "the-dead" in next(folder.iterdir()).read_text()
    with commanding("lab:1", "b"):
        pass


@pytest.mark.skipif(sys.platform == "win32", reason="links take a right there")
def test_link_in_place_of_the_lock_is_not_followed(tmp_path: Path, folder: Path) -> None:
    precious = tmp_path / "thesis.tex"
    precious.write_text("years of work", encoding="utf-8")
    folder.mkdir()
    with commanding("lab:1", "a"):
        (file,) = folder.iterdir()
    file.symlink_to(precious)
    with pytest.raises(ControllerTaken, match="lock file"), commanding("lab:1", "a"):
        pass
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(ControllerTaken, match="lock file"), commanding("lab:1", "a"):
        pass
    file.unlink()
    folder.rmdir()
    (tmp_path / "elsewhere").mkdir()
    folder.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ControllerTaken, match="it is not a folder"), commanding("lab:1", "a"):
        pass
    assert precious.read_text(encoding="utf-8") == "years of work"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="it takes root to act as another user")
def test_the_lock_of_another_user_holds_too(tmp_path: Path, folder: Path) -> None:
    tmp_path.chmod(0o777)
    for parent in tmp_path.parents:
        if parent.stat().st_uid == os.geteuid() and parent != Path("/"):
            parent.chmod(parent.stat().st_mode | 0o011)
    with commanding("lab:1", "a"):
        pass
    code = f"import os; from afspm.translator import controller_lock; controller_lock._COMMON = {str(tmp_path)!r}\n"
    code += "commanding = controller_lock.commanding\nimport fcntl, encodings.idna; os.setuid(65534)\n"
    code += "with commanding('lab:1', 'runs/of-nobody'): print('has it', flush=True); input()"
    other = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, encoding="utf-8"
    )
    assert other.stdin is not None
    assert other.stdout is not None
    with other:
        assert other.stdout.readline() == "has it\n"
        with pytest.raises(ControllerTaken, match="runs/of-nobody"), commanding("lab:1", "b"):
            pass
        other.stdin.write("\n")
    with commanding("lab:1", "b"):
        pass


def test_each_driver_has_the_address_of_its_controller_and_a_simulated_one_has_none(tmp_path: Path) -> None:
    assert Asylum(address="tcp://lab:5555").controller_at == "tcp://lab:5555"
    assert Nanonis(address="lab:6501,6502").controller_at == "lab:6501,6502"
    assert Gxsm(address="lab:65431").controller_at == "lab:65431"
    assert Nanosurf(address="lab:33030").controller_at == "lab:33030"
    assert Park(address="tcp://lab:5581").controller_at == "tcp://lab:5581"
    assert Simulator().controller_at == ""
    with commanding("", "a"), commanding("", "b"):
        assert not list(tmp_path.iterdir())


def test_translator_of_a_second_run_logs_the_first_and_ends_for_a_retry(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    launch = Launch("microscope", sockets=Sockets(), run_dir="runs/second")
    clock, log = ExperimentClock.from_dict(launch.clock), logging.getLogger("afspm.test")
    context = ProcessContext(launch, clock, open_port=pytest.fail, log=log, activity=ProcessActivity(clock))
    with commanding("lab:6501", "runs/first"):
        code = run_translator(Nanonis(address="lab:6501"), context, make=pytest.fail)
        assert code == ExitCode.CRASHED
        assert "commands this controller: runs/first" in caplog.text
        monkeypatch.setattr(translator, "_run_locked", lambda *_: ExitCode.ENDED)
        assert run_translator(NanonisShadow(address="lab:6501"), context) == ExitCode.ENDED, "it only reads"
