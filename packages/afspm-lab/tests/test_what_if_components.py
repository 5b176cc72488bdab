"""Components of a recorded night, replayed as they were and changed."""

from __future__ import annotations

import inspect
import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import what_if_lab as lab
from typer.testing import CliRunner

import afspm
from afspm import Memory, open_run, wire
from afspm.basics import ConfigError, FileError, InvalidValue
from afspm.supervisor import own_runs
from afspm.testing import Bench
from afspm_lab.what_if import component_replay, what_if
from afspm_lab.what_if.closed_loop import Outcomes
from afspm_lab.what_if.commands import DIFFERS, INCOMPLETE, app
from afspm_lab.what_if.port_replay import read_lives


def kills(bench: Bench) -> None:
    for when, name in (
        ("1 s", ""),
        ("11 min", ""),
        ("15 min", "judge"),
        ("25 min", "scheduler"),
        ("26 min", "alarmist"),
    ):
        bench.at(when, bench.kill, name)


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("night")
    bench = lab.record(folder, {"judge": lab.Judge(), "alarmist": lab.Alarmist()}, kills)
    assert len(bench.scans) >= 4
    return folder


def test_unchanged_night_with_kills_repeats_its_record(night: Path) -> None:
    result = afspm.what_if(night)
    assert result.first is None
    assert not result.hazards
    assert not result.unread
    rows = {row.name: row for row in result.table()}
    assert rows["series"].same > 15
    assert rows["judge"].same >= 4
    assert len(read_lives(night / "requests" / "series.jsonl")) >= 3  # it was killed


@pytest.mark.parametrize("seed", range(2, 4))
def test_killed_anywhere_the_unchanged_night_repeats_its_record(tmp_path: Path, seed: int) -> None:
    lab.record(tmp_path, {"judge": lab.Judge()}, kills_of_judge, seed=seed, dies_in_call=0.05)
    result = afspm.what_if(tmp_path)
    assert result.first is None
    assert len(read_lives(tmp_path / "requests" / "series.jsonl")) > 1


def test_ids_of_requests_are_no_difference(night: Path, tmp_path: Path) -> None:
    """Another version may number its requests in another way."""
    shutil.copytree(night, tmp_path, dirs_exist_ok=True)
    for log in (tmp_path / "requests").glob("*.jsonl"):
        log.write_text(re.sub(r'"session":"\w+"', '"session":"another"', log.read_text()))
    result = afspm.what_if(tmp_path)
    assert result.first is None
    assert not any(row.note for row in result.table())


def kills_of_judge(bench: Bench) -> None:
    for when in ("9 min", "19 min", "21 min"):
        bench.at(when, bench.kill, "judge")


def test_changed_setting_is_named_at_the_packet_where_it_first_decides_otherwise(night: Path) -> None:
    result = afspm.what_if(night, {"alarmist": {"at": 3}})
    first = result.first
    assert first is not None
    assert (first.component, first.kind) == ("alarmist", "removed")
    assert first.recorded is not None
    assert first.recorded.text == "flags tip-shape-changed"
    scans = [packet for packet in open_run(night).packets(messages=["Scan2d"]) if packet.envelope.endswith("Height")]
    assert first.packet is not None
    assert first.packet.time_ns == scans[1].time_ns
    assert result.counterfactual_from_ns == scans[1].time_ns
    rows = {row.name: row for row in result.table()}
    assert "repeats its record" in rows["alarmist"].note
    assert rows["judge"].same >= 4
    assert not rows["judge"].added + rows["judge"].removed + rows["judge"].changed


def test_difference_that_stays_away_from_the_microscope_is_not_counterfactual(night: Path) -> None:
    result = afspm.what_if(night, {"judge": {"factor": 0.0}})
    row = next(row for row in result.table() if row.name == "judge")
    assert row.changed
    assert result.counterfactual_from_ns is None
    assert row.counterfactual == 0


def test_changed_class_is_replayed_in_the_place_of_the_recorded_one(night: Path) -> None:
    class Rough(lab.Judge):
        def remark(self, scan: Any) -> str:
            return "rough"

    result = afspm.what_if(night, {"judge": Rough}, only=["judge"])
    assert list(result.components) == ["judge"]
    assert {one.now.text for one in result.differences if one.now} == {"rough"}


def test_component_that_asks_for_another_scan_ends_where_the_record_has_no_answer(night: Path) -> None:
    class Larger(lab.Series):
        def __init__(self) -> None:
            super().__init__()
            self.plan = type(self.plan)(self.plan.regions, (16, 16), self.plan.rounds)

    result = afspm.what_if(night, {"series": Larger}, only=["series"])
    row = result.table()[0]
    assert "no answer to" in row.note
    assert "16 x 16" in row.note
    assert result.first is not None
    assert result.first.reaches


def test_class_that_listens_to_more_than_its_record_is_noted(night: Path, tmp_path: Path) -> None:
    class Curious(lab.Judge):
        listens = ("Scan2d", "ScopeStateMsg")

    shutil.copytree(night, tmp_path, dirs_exist_ok=True)
    log = tmp_path / "requests" / "judge.jsonl"
    log.write_text(log.read_text().replace('"envelopes":null', '"envelopes":["Scan2d"]'))
    (row,) = afspm.what_if(tmp_path, {"judge": Curious}, only=["judge"]).table()
    assert row.note == "it listens to ScopeStateMsg, too, which its record lacks"
    (row,) = afspm.what_if(night, {"judge": Curious}, only=["judge"]).table()
    assert not row.note


def test_changed_memory_is_kept_over_a_kill_though_no_output_has_shown_it(tmp_path: Path) -> None:
    class Twice(lab.Counting):
        def counted(self, before: int) -> int:
            return before + 2 if before == 0 else super().counted(before)

    def kill(bench: Bench) -> None:
        bench.at("15 min", bench.kill, "counting")

    lab.record(tmp_path, {"counting": lab.Counting()}, kill)
    assert not afspm.what_if(tmp_path, only=["counting"]).differs
    first = afspm.what_if(tmp_path, {"counting": Twice}, only=["counting"]).first
    assert first is not None
    assert first.recorded is not None
    assert first.now is not None
    assert (first.recorded.text, first.now.text) == ("3 scans", "4 scans")
    assert first.recorded.life == 2


def test_error_of_a_changed_component_is_a_difference(night: Path) -> None:
    class Broken(lab.Judge):
        def remark(self, scan: Any) -> str:
            raise ZeroDivisionError

    result = afspm.what_if(night, {"judge": Broken}, only=["judge"])
    assert any(one.now and "ZeroDivisionError" in one.now.text for one in result.differences)


def test_missing_scan_is_no_difference_of_the_component(tmp_path: Path) -> None:
    lab.record(tmp_path, {"judge": lab.Judge()}, until="15 min", series=lab.FineSeries())
    for file in (tmp_path / "scans").iterdir():
        file.unlink()
    result = afspm.what_if(tmp_path)
    assert result.first is None
    assert result.unread.keys() == {"judge", "fine_series"}
    with pytest.raises(FileError, match="no such file"):
        afspm.what_if(tmp_path, {"judge": {"factor": 2.0}})


def test_class_that_can_not_be_created_is_named(night: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(judge: lab.Judge, factor: float = 1.0) -> None:
        raise OSError("no such port")

    monkeypatch.setattr(lab.Judge, "__init__", fails)
    result = afspm.what_if(night)
    assert result.first is None
    assert "can't be created: OSError: no such port" in result.unread["judge"]


def test_log_that_ends_before_the_run_is_noted(night: Path, tmp_path: Path) -> None:
    """As after a disk that was full from then on."""
    shutil.copytree(night, tmp_path, dirs_exist_ok=True)
    for log in (tmp_path / "requests").iterdir():
        text = log.read_bytes()
        log.write_bytes(text[: len(text) * 2 // 3])
    result = afspm.what_if(tmp_path)
    assert result.first is None
    notes = {row.name: row.note for row in result.table()}
    for name in ("judge", "alarmist", "scheduler"):
        assert "its record ends at " in notes[name], name
    (tmp_path / "requests" / "scheduler.steps.jsonl").write_bytes(b"")
    assert afspm.what_if(tmp_path).unread == {"scheduler": "its log is empty"}
    assert not any(row.note for row in afspm.what_if(night).table())


def test_line_of_a_limit_is_no_change_of_it() -> None:
    def limits(place: str, high: float) -> dict[str, Any]:
        return {"limits": {"parameters": {"bias": {"high": high, "source": place}}, "region_source": place}}

    recorded = limits("night.toml:12", 1.0)
    assert what_if.at_recorded_places(recorded, limits("new.toml:3", 1.0)) == recorded
    assert what_if.at_recorded_places(recorded, limits("new.toml:3", 2.0)) == limits("night.toml:12", 2.0)


def test_bad_changes_are_refused(night: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no requests of stranger"):
        afspm.what_if(night, {"stranger": {"factor": 1.0}})
    with pytest.raises(ConfigError, match="can't be made"):
        afspm.what_if(night, {"judge": {"no_such_setting": 1.0}})
    with pytest.raises(InvalidValue, match="a change can't be 3"):
        afspm.what_if(night, {"judge": 3})
    shutil.copy(night / "journal.sqlite", tmp_path)
    with pytest.raises(FileError, match="no recorded requests"):
        afspm.what_if(tmp_path)


def test_class_beside_the_experiment_file_is_found_as_in_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home, night = tmp_path / "home", tmp_path / "night"
    home.mkdir()
    night.mkdir()
    module = home / "lab_beside.py"
    module.write_text(
        "import what_if_lab as lab\nclass Beside(lab.Remarks):\n    def remark(self, scan):\n        return 'before'\n"
    )
    with monkeypatch.context() as while_recorded:
        while_recorded.syspath_prepend(str(home))
        lab.record(night, {"beside": import_module("lab_beside").Beside()}, until="15 min")
    del sys.modules["lab_beside"]
    (night / "run.json").write_text(json.dumps(own_runs.signed(night, [str(home)])))
    same = afspm.what_if(night)
    assert not same.unread
    assert same.first is None
    module.write_text(module.read_text().replace("before", "after it"))
    assert [one.now.text for one in afspm.what_if(night).differences if one.now][:1] == ["after it"]


def test_time_at_which_a_note_was_written_is_no_difference(night: Path) -> None:
    class Slower(lab.Judge):
        def remark(self, scan: Any) -> str:
            self.clock.now_ns()
            return "rough" if self.clock.now_ns() and super().remark(scan) == "rough" else "smooth"

    assert afspm.what_if(night, {"judge": Slower}, only=["judge"]).first is None
    result = afspm.what_if(night, {"judge": {"factor": 0.0}}, only=["judge"])
    assert all(one.recorded and one.now and one.recorded.text != one.now.text for one in result.differences)


def test_decision_between_two_packets_has_its_own_time(tmp_path: Path) -> None:
    lab.record(tmp_path, {"patient": lab.Patient()}, until="25 min")
    assert not any(row.note for row in afspm.what_if(tmp_path, only=["patient"]).table())
    result = afspm.what_if(tmp_path, {"patient": {"ticks": 10_000}})
    began_ns = open_run(tmp_path).oldest_ns
    assert result.first is not None
    assert result.first.at_ns - began_ns == pytest.approx(110 * 10e9, abs=11e9)  # its newest packet came at 10 min
    assert result.counterfactual_from_ns == result.first.at_ns
    earlier = afspm.what_if(tmp_path, {"patient": {"ticks": 105}})
    notes = {row.name: row.note for row in earlier.table()}
    assert notes == {**dict.fromkeys(notes, ""), "patient": "the same outputs, up to 50 s earlier or later"}


def test_loop_that_waits_for_a_time_ends_the_replay(tmp_path: Path) -> None:
    lab.record(tmp_path, {"settling": lab.Settling()}, until="15 min")
    assert afspm.what_if(tmp_path).first is None
    result = afspm.what_if(tmp_path, {"settling": {"settle_s": 2.0}}, only=["settling"])
    assert result.differs
    assert "it reads the clock without end" in result.table()[0].note


# --- mutants ---


def _mutants() -> dict[str, str]:
    source = inspect.getsource(lab.Judge.remark)
    changes = {
        "greater": ("roughness > ", "roughness < "),
        "never": ("if seen and", "if False and"),
        "always": ("if seen and", "if True or"),
        "product": ("self.factor *", "2.0 *"),
        "half": ("self.factor *", "0.5 *"),
        "number": ("/ len(seen)", "/ (len(seen) + 1)"),
        "newest": ("[*seen, roughness]", "[roughness]"),
        "oldest": ("[*seen, roughness]", "[*seen[:0], *(seen or [roughness])]"),
        "swapped": ('"rough" if', '"smooth" if'),
        "forgetful": ('self.memory.get("seen", [])', "[]"),
        "squared": ("np.std(scan.values)", "np.std(scan.values) ** 2"),
        "mean": ("np.std(scan.values)", "np.abs(np.mean(scan.values))"),
    }
    for before, _ in changes.values():
        assert before in source
    return {name: source.replace(*change) for name, change in changes.items()}


def _class_of(source: str) -> type[lab.Judge]:
    space: dict[str, Any] = {"np": np, "Scan": afspm.Scan}
    exec(textwrap.dedent(source), space)
    return type("Mutant", (lab.Judge,), {"remark": space["remark"]})


def _decided(class_: type[lab.Judge], scans: list[Any]) -> list[str]:
    judge = class_()
    judge.memory = Memory(None)
    return [judge.remark(scan) for scan in scans]


def test_mutants_are_found_at_the_packet_where_they_first_decide_otherwise(tmp_path: Path) -> None:
    """The truth: the decisions of original and mutant on the scans of the night, without any experiment."""
    lab.record(tmp_path, {"judge": lab.Judge()})
    with open_run(tmp_path) as run:
        packets = [one for one in run.packets(messages=["Scan2d"]) if one.envelope.endswith(lab.CHANNEL)]
        scans = [_scan(packet) for packet in packets]
        lives = read_lives(tmp_path / "requests" / "judge.jsonl")
        right, decided_otherwise = _decided(lab.Judge, scans), 0
        for name, source in _mutants().items():
            mutant = _class_of(source)
            pairs = enumerate(zip(right, _decided(mutant, scans), strict=True))
            truth = next((at for at, (one, other) in pairs if one != other), None)
            found = component_replay.replay(lives, run.packet_lookup(), tmp_path, make=_made(mutant)).first
            assert (found is None) == (truth is None), name
            if truth is not None:
                decided_otherwise += 1
                assert found is not None
                assert found.packet is not None, name
                assert found.packet.time_ns == packets[truth].time_ns, name
    assert decided_otherwise >= 6


def _made(class_: type[lab.Judge]) -> component_replay.Make:
    return lambda launch: class_()


def _scan(packet: Any) -> Any:
    return wire.decode("Scan2d", packet.payload)


# --- hazards ---


def test_hazards_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outside = tmp_path / "outside.txt"
    outside.write_text("before")
    monkeypatch.setenv(lab.OUTSIDE, str(outside))
    night = tmp_path / "night"
    night.mkdir()
    planted = {
        "wall_clock": (lab.WallClock(), "reads the wall clock by time_ns(), instead of self.clock (what_if_lab.py:"),
        "unseeded": (lab.Unseeded(), "draws random numbers without a seed of its own (what_if_lab.py:"),
        "unseeded_numpy": (lab.UnseededNumpy(), "draws random bytes of the operating system (what_if_lab.py:"),
        "shared_numpy": (lab.SharedNumpy(), "draws random numbers of numpy without a seed of its own"),
        "outside_file": (lab.OutsideFile(), f"reads a file that is not in the record: {outside}"),
    }
    lab.record(night, {name: component for name, (component, _) in planted.items()}, until="25 min")
    outside.write_text("after")
    result = afspm.what_if(night)
    assert result.hazards.keys() == planted.keys()
    for name, (_, words) in planted.items():
        assert any(words in hazard for hazard in result.hazards[name]), (name, result.hazards[name])
        assert result.components[name].first is not None
    read = f"reads the environment variable {lab.OUTSIDE} (what_if_lab.py:"
    assert any(read in hazard for hazard in result.hazards["outside_file"])


def test_order_of_a_set_and_the_process_are_named(tmp_path: Path) -> None:
    """Recorded by another process, as every night: the seed of the hashes of this one is another."""
    code = (
        "import sys, pathlib\nimport what_if_lab as lab\n"
        "judges = {'set_order': lab.SetOrder(), 'process': lab.ProcessNumber()}\n"
        "lab.record(pathlib.Path(sys.argv[1]), judges, until='15 min')"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONHASHSEED": "7"}
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True, env=environment)
    result = afspm.what_if(tmp_path, only=["set_order", "process"])
    assert result.first is not None
    of_process = "depends on its process, as by id() or os.getpid(): two processes give other outputs"
    assert result.hazards == {
        "set_order": ["depends on the order of a set: two hash seeds give other outputs, first its output 1"],
        "process": [f"{of_process}, first its output 1"],
    }


def test_replay_writes_nothing_outside_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table, night = tmp_path / "table.txt", tmp_path / "night"
    table.touch()
    monkeypatch.setenv(lab.OUTSIDE, str(table))
    night.mkdir()
    lab.record(night, {"writer": lab.Writer()}, until="15 min")
    written = table.read_text()
    assert written
    result = afspm.what_if(night)
    assert table.read_text() == written
    assert f"it writes a file outside its folder: {table}" in result.unread["writer"]
    assert not result.differs


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("way", ["thread", "pool", "program", "move", "hdf5", "sqlite", "socket"])
def test_replay_changes_nothing_outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    outside = tmp_path / "outside"
    monkeypatch.setenv(lab.OUTSIDE, str(outside))
    night = _outsiders_night(tmp_path, way)
    outside.unlink(missing_ok=True)
    result = afspm.what_if(night)
    assert not outside.exists()
    found = [*result.hazards.get("outsider", []), result.unread.get("outsider", "")]
    assert any(words in one for one in found for words in ("outside its folder", "the network", "a program"))


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
def test_replay_writes_to_no_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    controller, device = os.openpty()
    monkeypatch.setenv(lab.OUTSIDE, str(tmp_path / "outside"))
    monkeypatch.setenv(lab.DEVICE, os.ttyname(device))
    night = _outsiders_night(tmp_path, "device")
    assert b"PULSE" in os.read(controller, 1000)
    assert "writes a file outside its folder: /dev/" in afspm.what_if(night).unread["outsider"]
    os.set_blocking(controller, False)
    with pytest.raises(BlockingIOError):
        os.read(controller, 1)
    os.close(controller)
    os.close(device)


def _outsiders_night(folder: Path, way: str) -> Path:
    night = folder / "night"
    night.mkdir()
    lab.record(night, {"outsider": lab.Outsider(way)}, until="15 min")
    log = night / "requests" / "outsider.jsonl"
    log.write_text(log.read_text().replace('"settings":{}', f'"settings":{{"way":"{way}"}}', 1))
    return night


def test_temporary_files_and_tracebacks_are_no_hazard(tmp_path: Path) -> None:
    lab.record(tmp_path, {"tidy": lab.Tidy()}, until="15 min")
    result = afspm.what_if(tmp_path)
    assert result.first is None
    assert not result.hazards
    assert not result.unread


def test_component_with_inputs_from_people_is_left_out(tmp_path: Path) -> None:
    lab.record(tmp_path, {"page": lab.Page()}, until="15 min")
    result = afspm.what_if(tmp_path)
    assert not result.differs
    assert not result.unread
    assert result.left_out["page"] == "what people do at its pages is not in the record"


# --- the command ---


def test_command_exits_with_three_if_a_night_differs(night: Path) -> None:
    same = CliRunner().invoke(app, [str(night)])
    assert same.exit_code == 0, same.output
    assert "no difference" in same.output
    differs = CliRunner().invoke(app, [str(night), "--set", "alarmist.at=3"])
    assert differs.exit_code == DIFFERS, differs.output
    assert "first difference: alarmist" in differs.output
    assert "flags tip-shape-changed" in differs.output


def test_command_replays_the_other_nights_after_one_that_can_not_be_replayed(night: Path, tmp_path: Path) -> None:
    older, latest, page = tmp_path / "older", tmp_path / "latest", tmp_path / "page.html"
    older.mkdir()
    shutil.copy(night / "journal.sqlite", older)  # without requests
    latest.symlink_to(night)
    (tmp_path / "runs.sqlite").touch()
    nights = [*map(str, (older, latest, night, tmp_path / "runs.sqlite"))]
    same = CliRunner().invoke(app, nights)
    assert same.exit_code == INCOMPLETE, same.output
    assert "older was not replayed: " in same.output
    assert same.output.count("no difference") == 1
    differs = CliRunner().invoke(app, [*nights, "--set", "alarmist.at=3", "--page", str(page)])
    assert differs.exit_code == DIFFERS, differs.output
    assert "older: not replayed" in page.read_text(encoding="utf-8")


def test_command_exits_with_one_if_a_component_can_not_be_replayed(night: Path, tmp_path: Path) -> None:
    shutil.copytree(night, tmp_path, dirs_exist_ok=True)
    log = tmp_path / "requests" / "judge.jsonl"
    log.write_text(log.read_text().replace("what_if_lab.Judge", "what_if_lab.Gone"))
    result = CliRunner().invoke(app, [str(tmp_path)])
    assert result.exit_code == INCOMPLETE, result.output
    assert "judge was not replayed: " in result.output


def test_run_that_names_classes_of_moved_modules_is_read(night: Path, tmp_path: Path) -> None:
    shutil.copytree(night, tmp_path, dirs_exist_ok=True)
    moved = "afspm.plugins.agent.agent.Agent"
    log = tmp_path / "requests" / "judge.jsonl"
    log.write_text(log.read_text().replace("what_if_lab.Judge", moved))
    (tmp_path / "run.json").write_text(json.dumps({"classes": {"judge": moved}, "homes": ["afspm.plugins.what_if"]}))
    assert len(open_run(tmp_path).scans) == len(open_run(night).scans) > 0
    result = afspm.what_if(tmp_path)
    assert moved.rpartition(".")[0] in result.unread["judge"]
    assert any(row.name == "series" and row.same for row in result.table())


def test_command_prints_json_for_programs(night: Path) -> None:
    result = CliRunner().invoke(app, [str(night), "--set", "judge.factor=0.0", "--component", "judge", "--json"])
    assert result.exit_code == DIFFERS
    facts = json.loads(result.output)
    assert facts["first"]["component"] == "judge"
    assert facts["first"]["packet"]["envelope"].startswith("Scan2d")
    assert [row["name"] for row in facts["table"]] == ["judge"]


@pytest.mark.parametrize(
    ("scans", "lasted_alike", "differs"), [("10", True, False), ("10", False, True), ("9", True, True)]
)
def test_duration_of_equal_nights_is_no_difference(scans: str, lasted_alike: bool, differs: bool) -> None:
    rows = {"lasted": ("1 h 18 min", "1 h 23 min"), "whole scans": ("10", scans)}
    assert Outcomes(Path("again"), rows, lasted_alike).differs == differs


@pytest.mark.parametrize(
    "given",
    [
        ["x.toml"],
        ["run", "a.toml", "b.toml"],
        ["run", "--set", "judge"],
        ["run", "--page", "no-such-folder/page.html"],
        ["run", "--closed", "--page", "page.html"],
    ],
)
def test_command_refuses_what_it_can_not_read(given: list[str]) -> None:
    assert CliRunner().invoke(app, given).exit_code == 2
