"""One run at a time commands a controller."""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import BinaryIO

import pytest
from deadlines import DEADLINE_S
from temporary_folder import use_temporary_folder

from afspm.basics.clock import ExperimentClock
from afspm.basics.exit_codes import ExitCode
from afspm.basics.file_lock import lock
from afspm.basics.launch import Launch, Sockets
from afspm.plugins.asylum import Asylum
from afspm.plugins.gxsm import Gxsm
from afspm.plugins.nanonis import Nanonis
from afspm.plugins.nanosurf import Nanosurf
from afspm.plugins.park import Park
from afspm.simulation.simulator import Simulator
from afspm.translator import controller_lock
from afspm.translator.controller_lock import ControllerTaken, commanding
from afspm.translator.translator import run_translator
from afspm.transport.process.context import ProcessActivity, ProcessContext

DIES_HOLDING = """
import os, sys
from afspm.translator.controller_lock import commanding
with commanding(sys.argv[1], "runs/the-dead"):
    os._exit(1)
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the locks."""
    use_temporary_folder(tmp_path, monkeypatch)
    monkeypatch.setenv("PROGRAMDATA", str(tmp_path))
    return tmp_path / "afspm-controllers"


@pytest.mark.parametrize("other", ["lab-1:6501", "LAB-1:6501"])
def test_second_run_is_refused_with_the_name_of_the_first(other: str) -> None:
    with commanding("lab-1:6501", "runs/first"):
        with (
            pytest.raises(ControllerTaken, match=f"commands this controller: runs/first, process {os.getpid()}"),
            commanding(other, "b"),
        ):
            pass
        with commanding("lab-2:6501", "runs/second"):
            pass
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


def test_this_computer_is_the_same_by_name_and_number() -> None:
    with commanding("localhost:6501", "a"), pytest.raises(ControllerTaken), commanding("127.0.0.1:6501", "b"):
        pass


def test_a_run_that_failed_or_was_killed_leaves_nothing_locked(tmp_path: Path, folder: Path) -> None:
    with contextlib.suppress(ZeroDivisionError), commanding("lab:1", "a"):
        raise ZeroDivisionError
    environment = {**os.environ, "TMPDIR": str(tmp_path), "TEMP": str(tmp_path), "TMP": str(tmp_path),
                   "PROGRAMDATA": str(tmp_path)}  # fmt: skip
    died = subprocess.run(
        [sys.executable, "-c", DIES_HOLDING, "lab:1"], env=environment, check=False, timeout=DEADLINE_S
    )
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
    code = f"import os, tempfile; tempfile.tempdir = {str(tmp_path)!r}\n"
    code += "from afspm.translator.controller_lock import commanding\nimport fcntl; os.setuid(65534)\n"
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
    caplog: pytest.LogCaptureFixture,
) -> None:
    launch = Launch("microscope", sockets=Sockets(), run_dir="runs/second")
    clock, log = ExperimentClock.from_dict(launch.clock), logging.getLogger("afspm.test")
    context = ProcessContext(launch, clock, open_port=pytest.fail, log=log, activity=ProcessActivity(clock))
    with commanding("lab:6501", "runs/first"):
        code = run_translator(Nanonis(address="lab:6501"), context, make=pytest.fail)
    assert code == ExitCode.CRASHED
    assert "commands this controller: runs/first" in caplog.text
