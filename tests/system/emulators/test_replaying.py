"""The trace of an experiment, played back: an equal experiment measures the same, a different one is reported."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from deadlines import DEADLINE_S
from makers import MAKERS
from rotation import rotated

from afspm.record.run_json import run_json_or_empty
from afspm.translator.trace import FILE, TracedExchange, TracedFile, TraceHeader, read_trace

ROOT = Path(__file__).parents[3]
FILES = ROOT / "experiments" / "every_microscope"
AFSPM = (sys.executable, "-c", "from afspm.cli import main; main()")
REPLAY = """
[clock]
start = {start}

[controller]
component = true
class = "TraceReplay"
trace = {trace}
files = {files}

[microscope]
component = true
class = "{driver}"
{where}
"""
OTHER = """
[details]
regions = [{ center = ["0 nm", "0 nm"], size = ["400 nm", "500 nm"] }]

[ender]
component = true
class = "ender.Ender"
"""
ENDER = """
from afspm import Component


class Ender(Component):
    has_begun = False  # a controller that starts late is a problem as well

    def on_scan_parameters(self, parameters):
        self.has_begun = True

    def on_problem(self, problem, flagged):
        if self.has_begun and flagged:
            self.scope.end_experiment()
"""


def run(folder: Path, command: str, *files: Path) -> tuple[subprocess.CompletedProcess[str], Path]:
    arguments = [*AFSPM, command, *map(str, files), "--runs", str(folder / "runs")]
    try:
        done = subprocess.run(arguments, capture_output=True, encoding="utf-8", timeout=DEADLINE_S, check=False)
    except subprocess.TimeoutExpired as error:
        pytest.fail(f"{error}:\n{error.stdout!r}\n{error.stderr!r}")
    runs = sorted((folder / "runs").glob("*-*"))
    assert runs, done.stdout + done.stderr
    return done, runs[-1]


VENDORS = tuple(f"{name}{way}" for name in MAKERS for way in ("", *(f"-{one}" for one in MAKERS[name].transports)))


@pytest.fixture(scope="module", params=rotated(VENDORS, len(VENDORS)))
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, Path]:
    """The vendor, a trace, and the file of an experiment that plays it back."""
    vendor, _, transport = str(request.param).partition("-")
    if transport and not sys.platform.startswith("linux"):
        pytest.skip("GXSM's shared memory is there on Linux alone")
    folder = tmp_path_factory.mktemp("recorded")
    how = folder / "how.toml"
    how.write_text(f'[controller]\ntransport = "{transport}"\n' if transport else "", encoding="utf-8")
    done, ran = run(folder, "trace", FILES / "experiment.toml", MAKERS[vendor].emulated, how)
    assert done.returncode == 0, done.stdout + done.stderr
    assert str(ran / FILE) in done.stdout
    trace = Path(shutil.move(ran / FILE, folder))
    header = read_trace(trace)[0]
    assert isinstance(header, TraceHeader)
    # long before: a file must not look older than its scan on a computer that takes longer than the one that recorded
    start = (datetime.fromisoformat(header.began) - timedelta(hours=10)).isoformat()
    files = folder / "files"
    here, before = json.dumps(str(files)), str(ran / "controller").replace("/", ":")  # as Igor writes folders
    where = MAKERS[vendor].files.format(here=here, there=json.dumps(before))
    names = {"start": start, "trace": json.dumps(str(trace)), "files": here, "driver": header.driver}
    file = folder / "replay.toml"
    file.write_text(REPLAY.format(**names, where=where), encoding="utf-8")
    files.mkdir()
    shutil.rmtree(ran)  # nothing of it is left to be found
    return vendor, trace, file


def test_trace_has_every_question_and_the_files(recorded: tuple[str, Path, Path]) -> None:
    _, trace, _ = recorded
    lines = read_trace(trace)
    exchanges = [line for line in lines if isinstance(line, TracedExchange)]
    assert any(one.command == "ACTION start-scan" for one in exchanges)
    assert any(not one.command for one in exchanges)
    assert all(one.answered or one.lost for one in exchanges)
    assert [line for line in lines if isinstance(line, TracedFile)]


def test_trace_has_no_secret(recorded: tuple[str, Path, Path]) -> None:
    vendor, trace, _ = recorded
    secret = Path("~/.afspm/gxsm-bridge-secret").expanduser()
    if vendor != "gxsm":
        pytest.skip("only GXSM's bridge has a secret")
    assert secret.read_text(encoding="utf-8").strip() not in trace.read_text(encoding="utf-8")


def test_same_experiment_measures_the_same_again(recorded: tuple[str, Path, Path], tmp_path: Path) -> None:
    _, _, file = recorded
    done, ran = run(tmp_path, "run", FILES / "experiment.toml", file)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 scans" in done.stdout
    result = json.loads((ran / "controller" / "replay.json").read_text(encoding="utf-8"))
    assert result == {"deviation": "", "not_asked": 0, "same": True}
    assert run_json_or_empty(ran)["simulated"] is True


def test_different_experiment_is_reported_at_the_first_difference(
    recorded: tuple[str, Path, Path], tmp_path: Path
) -> None:
    vendor, trace, file = recorded
    other = tmp_path / "other.toml"
    # a busy computer's late answer would be a problem, too, which ends the experiment before there is a difference
    patient = '[microscope]\nreply_timeout_s = "30 s"\n' if MAKERS[vendor].takes("reply_timeout_s") else ""
    other.write_text(OTHER + patient, encoding="utf-8")
    (tmp_path / "ender.py").write_text(ENDER, encoding="utf-8")
    _, ran = run(tmp_path, "run", FILES / "experiment.toml", file, other)
    deviation = json.loads((ran / "controller" / "replay.json").read_text(encoding="utf-8"))["deviation"]
    assert "(of SET_SCAN_PARAMS" in deviation
    number = int(deviation.split("line ")[1].split(":")[0])
    recorded_there = read_trace(trace)[number - 1]
    assert isinstance(recorded_there, TracedExchange)
    assert recorded_there.command.startswith("SET_SCAN_PARAMS")
