"""The commands that read an experiment file."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest
from published_schemas import require_valid
from typer.testing import CliRunner

from afspm.cli.app import app

from .conftest import Write

CORRECTOR = '[repair]\ncomponent = true\nclass = "parts.Corrector"\n'


@pytest.fixture
def runner(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> CliRunner:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    return CliRunner()


def test_check_of_a_good_file_ends_with_0(write: Write, runner: CliRunner) -> None:
    write(CORRECTOR)
    result = runner.invoke(app, ["check", "night.toml"])
    assert result.exit_code == 0
    assert "night: 4 processes, nothing wrong" in result.output


def test_check_prints_every_error_with_file_and_line_and_ends_with_1(write: Write, runner: CliRunner) -> None:
    write("[clock]\nsped = 2\n" + CORRECTOR + 'volage = "3 V"\nvoltage = "2 nm"\n')
    result = runner.invoke(app, ["check", "night.toml"])
    assert result.exit_code == 1
    assert "night.toml:2: error: [clock] sped is not a setting\n    did you mean 'speed'?" in result.output
    assert "night.toml:6: error: [repair] has no setting 'volage'" in result.output
    assert "night.toml:7: error: [repair] voltage = '2 nm'" in result.output
    assert "3 errors" in result.output


def test_check_of_a_missing_file_prints_only_that(runner: CliRunner) -> None:
    result = runner.invoke(app, ["check", "absent.toml"])
    assert result.exit_code == 1
    assert result.output == "absent.toml: error: the file can't be read: No such file or directory\n"


def test_check_of_a_folder_asks_for_the_experiment_file(runner: CliRunner, tmp_path: Path) -> None:
    result = runner.invoke(app, ["check", str(tmp_path)])
    assert result.exit_code == 1
    assert f"{tmp_path}: error: this is a folder, not an experiment file\n" in result.output
    assert "afspm run --resume" in result.output


def test_check_merges_files(write: Write, runner: CliRunner) -> None:
    write(CORRECTOR, '[repair]\nvoltage = "2 nm"\n')
    result = runner.invoke(app, ["check", "night.toml", "over1.toml"])
    assert "over1.toml:2: error" in result.output


def test_check_prints_the_expanded_file(write: Write, runner: CliRunner) -> None:
    write('volts = "2 V"\n' + CORRECTOR + 'voltage = "volts"\n')
    result = runner.invoke(app, ["check", "night.toml", "--expanded"])
    assert tomllib.loads(result.stdout)["repair"]["voltage"] == "2 V"


def test_graph_writes_an_svg(write: Write, runner: CliRunner, tmp_path: Path) -> None:
    write(CORRECTOR)
    assert runner.invoke(app, ["graph", "night.toml", "-o", "out.svg"]).exit_code == 0
    assert (tmp_path / "out.svg").read_text(encoding="utf-8").startswith("<svg")


def test_keys_makes_a_pair_for_each_process_and_person_and_leaves_old_ones(
    write: Write, runner: CliRunner, tmp_path: Path
) -> None:
    write(CORRECTOR)
    assert runner.invoke(app, ["keys", "night.toml", "--also", "ana"]).exit_code == 0
    public = {file.stem for file in (tmp_path / "keys" / "public").iterdir()}
    assert public == {"repair", "scheduler", "microscope", "recorder", "supervisor", "ana"}
    before = (tmp_path / "keys" / "public" / "ana.key").read_text()
    result = runner.invoke(app, ["keys", "night.toml", "--also", "ana"])
    assert "there already" in result.output
    assert (tmp_path / "keys" / "public" / "ana.key").read_text() == before
    assert runner.invoke(app, ["keys", "night.toml", "-q"]).output == ""


@pytest.mark.parametrize(
    ("words", "some"),
    [
        (("afspm", ""), {"run", "export", "drift", "bench"}),
        (("afspm", "drift", ""), {"files"}),
        (("afspm", "new", "d"), {"driver"}),
        (("afspm", "replay", "--"), {"--speed"}),
    ],
)
def test_shell_completes_commands_of_all_packages_and_their_options(
    words: tuple[str, ...], some: set[str], runner: CliRunner
) -> None:
    asked = {"_AFSPM_COMPLETE": "complete_bash", "COMP_WORDS": " ".join(words), "COMP_CWORD": str(len(words) - 1)}
    assert some <= {*runner.invoke(app, [], prog_name="afspm", env=asked).stdout.split()}


@pytest.mark.parametrize("group", [(), ("new",), ("shadow",), ("drift",), ("bench",)])
def test_bare_group_of_commands_shows_its_help_and_ends_with_0(group: tuple[str, ...], runner: CliRunner) -> None:
    bare, helped = runner.invoke(app, [*group]), runner.invoke(app, [*group, "--help"])
    assert (bare.exit_code, bare.stdout) == (0, helped.stdout)
    assert ("--install-completion" in bare.stdout) is not group, "completion is installed for all commands at once"


def test_help_keeps_names_in_brackets_and_fills_its_paragraphs(runner: CliRunner) -> None:
    helped = " ".join(runner.invoke(app, ["keys", "--help"]).output.split())
    assert "Default: [security] keys of the file" in helped
    lines = runner.invoke(app, ["run", "--help"]).output.splitlines()
    paragraph = [line for line in lines if "Ctrl-C ends the" in line]
    assert len(paragraph) == 1
    assert len(paragraph[0].rstrip()) > 70


def test_each_command_is_listed_in_its_panel_with_its_whole_first_paragraph(runner: CliRunner) -> None:
    helped = runner.invoke(app, ["--help"]).output
    order = ["run ", "Before", "check", "While it runs", "watch", "Afterwards", "report", "Microscopes", "emulate"]
    places = [helped.index(f"\n{title}:\n" if title[0].isupper() else f"\n  {title}") for title in order]
    assert places == sorted(places)
    assert "Does not disturb the experiment." in " ".join(helped.split())


def test_version_is_printed(runner: CliRunner) -> None:
    result = runner.invoke(app, ["--version"])
    assert result.exit_code == 0
    assert result.output.split()[0] == "afspm"
    assert result.output.split()[1][0].isdigit()


def test_check_estimates_the_work_and_the_end(runner: CliRunner, tmp_path: Path) -> None:
    components = {
        "microscope": 'class = "Simulator"\ninitial = { scan-speed = "4 um/s" }',
        "scheduler": 'class = "Scheduler"',
        "series": 'class = "ScanSeries"\nsize = ["2 um", "2 um"]\npixels = [100, 100]\nevery = "10 min"\nscans = 7',
    }
    text = "\n".join(f"[{name}]\ncomponent = true\n{lines}" for name, lines in components.items())
    (tmp_path / "night.toml").write_text(f"[clock]\nspeed = 61.0\n{text}\n", encoding="utf-8")
    result = runner.invoke(app, ["check", "night.toml"])
    assert result.exit_code == 0
    assert "series plans 7 scans, 2.8 mm scanned, 0.56 MB a channel before compression, 1 h 02 min" in result.output
    assert "(1 h 02 min, 1 min 01 s real)" in result.output


def test_findings_are_json_for_programs(write: Write, runner: CliRunner) -> None:
    write("size_of = 3\n" + CORRECTOR + 'volage = "3 V"\n')
    result = runner.invoke(app, ["check", "--json", "night.toml"])
    assert result.exit_code == 1
    unused, wrong = sorted(json.loads(result.stdout), key=lambda one: one["line"])
    assert unused == {
        "level": "warning", "file": "night.toml", "line": 1, "what": "nothing uses the variable 'size_of'", "hint": "",
    }  # fmt: skip
    assert (wrong["level"], wrong["what"]) == ("error", "[repair] has no setting 'volage'")
    require_valid("check", [unused, wrong])
    write(CORRECTOR)
    good = runner.invoke(app, ["check", "--json", "night.toml"])
    assert (good.exit_code, json.loads(good.stdout)) == (0, [])
