"""A sealed process reads what it was given, writes into its own folder, and has no way to the truth."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S

import afspm
from afspm.basics import ConfigError, FileError, python_command
from afspm_bench import sealing
from afspm_bench.agent_files import LINES_FILE, AgentFiles
from afspm_bench.evidence import read_report
from afspm_bench.sealing import Seal

pytestmark = pytest.mark.skipif(bool(sealing.unavailable()), reason=f"no seal here: {sealing.unavailable()}")
UNIQUE = f"afspm_test_of_the_seal_{os.getpid()}"
SITE = Path(sysconfig.get_paths()["purelib"])
TRY_ALL = """
import json, os, sys

def attempt(way, path):
    if way == "read":
        open(path, "rb").read(1)
    elif way == "list":
        os.listdir(path)
    elif way == "write":
        os.close(os.open(path, os.O_WRONLY))
    elif way == "truncate":
        os.truncate(path, os.path.getsize(path))
    elif way == "create":
        open(path, "x").close()
        os.remove(path)
    elif way == "remove":
        os.remove(path)
    elif way == "link":
        os.link(path, "linked")
        os.remove("linked")
    elif way == "signal":
        os.kill(int(path), 0)

def outcome(way, path):
    try:
        attempt(way, path)
    except PermissionError:
        return "denied"
    except OSError as error:
        return "denied" if error.errno == 18 else str(error)  # a link to another folder
    return "done"

print(json.dumps({name: outcome(*ways) for name, ways in json.loads(sys.argv[1]).items()}))
"""


class Bench:
    """A current folder with an agent, the output of a bench inside, and the folders of its trials elsewhere."""

    def __init__(self, folder: Path) -> None:
        self.here, self.owns = folder / "here", folder / "tmp" / "afspm-bench-1"
        self.own, self.modules = self.owns / "mine", self.owns / "mine-modules"
        for made in (self.own, self.owns / "other", self.here / "packed", self.here / "weights"):
            made.mkdir(parents=True)
        self.output, self.earlier = (self.made_output(name) for name in ("bench", "earlier"))
        for name in ("my_agent.py", "helper.py", "packed/__init__.py", "packed/table.csv", "weights/one", "notes.txt"):
            (self.here / name).write_text("")
        (self.owns / "other" / "report.json").write_text("{}")

    def made_output(self, name: str) -> Path:
        output = self.here / name
        (output / "work" / "trial").mkdir(parents=True)
        for file in (LINES_FILE, "key.txt", "work/trial/truth.jsonl", "work/trial/experiment.toml"):
            (output / file).write_text("seed 7")
        return output

    def files(self, *read: Path, command: tuple[str, ...] = ()) -> AgentFiles:
        return AgentFiles(command, [str(self.here)], read)

    def sealed(self, *command: str, read: tuple[Path, ...] = (), **given: int) -> str:
        files = self.files(*read)
        files.link_modules(self.modules)
        readable = tuple(map(str, (self.modules, *files.readable)))
        seal = Seal(str(self.own), readable, **given)
        return run(seal.command(python_command("afspm_bench.sealing"), command), self.own)

    def outcomes(self, ways: Mapping[str, tuple[str, Any]], *, sealed: bool = True, **given: Any) -> Any:
        command = (
            sys.executable,
            "-c",
            TRY_ALL,
            json.dumps({name: (way, str(at)) for name, (way, at) in ways.items()}),
        )
        return json.loads(self.sealed(*command, **given) if sealed else run(command, self.own))


def run(command: tuple[str, ...], folder: Path) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S, check=False, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def ways_out(bench: Bench) -> dict[str, tuple[str, Any]]:
    trial, profile = bench.output / "work" / "trial", bench.here / ".bashrc"
    profile.write_text("")
    return {
        "truth": ("read", trial / "truth.jsonl"),
        "experiment": ("read", trial / "experiment.toml"),
        "key": ("read", bench.output / "key.txt"),
        "lines": ("read", bench.output / LINES_FILE),
        "names in the output": ("list", bench.output),
        "truth by another root": ("read", f"/proc/{os.getpid()}/root{trial / 'truth.jsonl'}"),
        "truth by a hard link": ("link", trial / "truth.jsonl"),
        "line of another trial": ("write", bench.output / LINES_FILE),
        "shorter lines": ("truncate", bench.output / LINES_FILE),
        "removed lines": ("remove", bench.earlier / LINES_FILE),
        "truth of an earlier bench": ("read", bench.earlier / "work" / "trial" / "truth.jsonl"),
        "experiment of an earlier bench": ("read", bench.earlier / "work" / "trial" / "experiment.toml"),
        "key of an earlier bench": ("read", bench.earlier / "key.txt"),
        "answer of another trial": ("read", bench.owns / "other" / "report.json"),
        "other answer": ("write", bench.owns / "other" / "report.json"),
        "trials": ("list", bench.owns),
        "the sealer": ("write", sealing.__file__),
        "a shorter sealer": ("truncate", sealing.__file__),
        "the judge": ("write", Path(sealing.__file__).with_name("judging.py")),
        "afspm": ("write", afspm.__file__),
        "the start of Python": ("create", SITE / f"{UNIQUE}.pth"),
        "a package": ("create", SITE / f"{UNIQUE}.py"),
        "Python": ("write", Path(os.__file__)),
        "a module of afspm": ("create", Path(afspm.__file__).with_name(f"{UNIQUE}.py")),
        "home": ("list", Path.home()),
        "in home": ("create", Path.home() / f".{UNIQUE}"),
        "profile": ("write", profile),
        "current folder": ("list", bench.here),
        "in the current folder": ("create", bench.here / "sitecustomize.py"),
        "the agent": ("write", bench.here / "my_agent.py"),
        "its links": ("create", bench.modules / "sealed.py"),
        "notes": ("read", bench.here / "notes.txt"),
        "shared memory": ("create", f"/dev/shm/{UNIQUE}"),
        "temporary files": ("create", f"/tmp/{UNIQUE}"),
    }  # fmt: skip


def test_sealed_process_has_no_way_out(bench: Bench) -> None:
    ways = ways_out(bench)
    assert bench.outcomes(ways) == dict.fromkeys(ways, "denied")


def test_ways_out_are_open_without_the_seal(bench: Bench) -> None:
    # otherwise the test above would prove nothing
    bench.modules.mkdir()
    ways = ways_out(bench)
    assert bench.outcomes(ways, sealed=False) == dict.fromkeys(ways, "done")


@pytest.mark.skipif(sealing._version() < 6, reason="this kernel's Landlock can't deny signals")
def test_sealed_process_signals_no_process_outside(bench: Bench) -> None:
    assert bench.outcomes({"this test": ("signal", os.getpid())}) == {"this test": "denied"}


def test_children_of_a_sealed_process_are_sealed(bench: Bench) -> None:
    truth = str(bench.output / "work" / "trial" / "truth.jsonl")
    child = f"import subprocess; print(subprocess.run(['cat', {truth!r}]).returncode)"
    assert bench.sealed(sys.executable, "-c", child) == "1\n"


def test_sealed_process_uses_its_own_folder_its_modules_and_the_given_files(bench: Bench) -> None:
    ways = {
        "own file": ("create", bench.own / "report.json"),
        "own names": ("list", bench.own),
        "weights": ("read", bench.here / "weights" / "one"),
        "package data": ("read", bench.here / "packed" / "table.csv"),
        "agent": ("read", bench.here / "my_agent.py"),
        "random": ("read", "/dev/urandom"),
        "nowhere": ("write", "/dev/null"),
        "users": ("read", "/etc/passwd"),
        "program": ("read", shutil.which("cat")),
    }  # fmt: skip
    found = bench.outcomes(ways, read=(bench.here / "weights",))
    assert found == dict.fromkeys(ways, "done")


LEAVING = """
import os, sys, time
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        print(os.getpid(), flush=True)
        time.sleep(3600)
    os._exit(0)
os.wait()
if sys.argv[1:] == ["stays"]:
    time.sleep(3600)
"""


# faults 13
@pytest.mark.parametrize("stays", [False, True])
def test_processes_that_a_sealed_one_leaves_end_with_it(bench: Bench, stays: bool) -> None:
    command = [sys.executable, "-c", LEAVING, *(["stays"] if stays else [])]
    seal = Seal(str(bench.own), tuple(map(str, bench.files().readable)))
    with subprocess.Popen(
        seal.command(python_command("afspm_bench.sealing"), command), stdout=subprocess.PIPE, text=True
    ) as started:
        assert started.stdout is not None
        left = int(started.stdout.readline())
        if stays:
            started.terminate()
        assert (started.wait(DEADLINE_S) != 0) is stays
        with pytest.raises(ProcessLookupError):
            os.kill(left, 0)


LEFT = {  # faults 2
    "a pipe": ("os.mkfifo('report.json')", "is no regular file"),
    "an endless device": ("os.symlink('/dev/zero', 'report.json')", "can't be read"),
    "a folder": ("os.mkdir('report.json')", "is no regular file"),
    "a socket": ("socket.socket(socket.AF_UNIX).bind('report.json')", "can't be read"),
    "too much": ("open('report.json', 'w').write('1' * (1 << 21))", "is larger than 1048576 bytes"),
    "a hole": ("os.truncate(os.open('report.json', os.O_CREAT | os.O_RDWR), 1 << 30)", "is larger than"),
    "depth": ("open('report.json', 'w').write('{\"status\": \"ask\", \"asks\": ' + '['*40 + ']'*40 + '}')", "levels"),
    "nesting": ("open('report.json', 'w').write('[' * 500000)", "can't be read"),
}  # fmt: skip


@pytest.mark.parametrize("what", LEFT)
def test_report_that_can_hang_or_fill_the_bench_is_refused_at_once(bench: Bench, what: str) -> None:
    code, reason = LEFT[what]
    bench.sealed(sys.executable, "-c", f"import os, socket; {code}")
    report, why = read_report(bench.own / "report.json")
    assert report is None
    assert reason in why


def test_sealed_process_writes_no_larger_file_than_it_may(bench: Bench) -> None:
    code = "f = open('large', 'wb', 0)\ntry:\n while True: f.write(bytes(4096))\nexcept OSError as e: print(e.errno)"
    assert bench.sealed(sys.executable, "-c", code, most_bytes=1 << 16) == f"{errno.EFBIG}\n"
    assert (bench.own / "large").stat().st_size == 1 << 16


def test_modules_beside_the_output_are_imported_with_their_helpers(bench: Bench) -> None:
    (bench.here / "my_agent.py").write_text("import helper, packed.inner, afspm, numpy\nprint(packed.inner.__name__)")
    (bench.here / "packed" / "inner.py").write_text("import json")
    code = f"import sys; sys.path[:0] = [{str(bench.modules)!r}]; import my_agent"
    assert bench.sealed(sys.executable, "-c", code) == "packed.inner\n"


def test_program_that_the_seal_keeps_from_starting_is_named(bench: Bench) -> None:
    program = bench.here / "program"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    command = Seal(str(bench.own), ()).command(python_command("afspm_bench.sealing"), [str(program)])
    done = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert done.returncode
    assert f"{program} can't be started by a sealed process" in done.stderr
    assert "--read" in done.stderr
    assert program in bench.files(command=(str(program),)).readable


def test_folder_with_an_output_is_never_readable(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.files().require_no_output(bench.output, bench.owns)
    for read in (bench.here, bench.earlier, bench.output / "work", bench.output / "key.txt"):
        with pytest.raises(ConfigError, match="the agent could read the output of a bench"):
            bench.files(read).require_no_output(bench.output, bench.owns)
    monkeypatch.setenv("PYTHONPATH", str(bench.here))
    with pytest.raises(ConfigError, match="PYTHONPATH"):
        bench.files().require_no_output(bench.output, bench.owns)
    monkeypatch.delenv("PYTHONPATH")
    bench.earlier.rename(bench.here / "packed" / "results")
    with pytest.raises(ConfigError, match="results"):
        bench.files().require_no_output(bench.output, bench.owns)


def test_missing_file_to_read_is_named(bench: Bench) -> None:
    with pytest.raises(FileError, match="no such file or folder"):
        bench.files(bench.here / "lost")


def test_interpreter_of_a_virtual_environment_is_readable_with_its_base(bench: Bench) -> None:
    program = bench.here / "venv" / "bin" / "python3"
    program.parent.mkdir(parents=True)
    program.symlink_to(sys.executable)
    (bench.here / "venv" / "pyvenv.cfg").write_text("")
    readable = bench.files(command=(str(program), "my_model.py")).readable
    assert {bench.here / "venv", Path(sys.executable).resolve()} <= {*readable}


def test_old_landlock_is_refused_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    for version, why in ((0, "no Landlock"), (-1, "no Landlock"), (2, "version 2, which can't keep a process from")):
        monkeypatch.setattr(sealing, "_version", lambda version=version: version)
        assert why in sealing.unavailable()
        with pytest.raises(sealing.SealingFailed, match=r"Linux 6\.2"):
            sealing.seal(Seal("/", ()))
