"""Checks between the parts of an experiment: each broken once, and files without findings."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from afspm.experiment import Experiment, load, load_expanded
from afspm.experiment.implied_parts import NO_PROGRAM

from .conftest import FRAME, Write, errors, line_of, only_error

CLASSIFIER = '[watch]\ncomponent = true\nclass = "parts.Classifier"\n'
CORRECTOR = '[repair]\ncomponent = true\nclass = "parts.Corrector"\n'
PEAKS = '[peaks]\ncomponent = true\nclass = "parts.Peaks"\n'
LOG = '[log]\ncomponent = true\nclass = "parts.Listener"\n'
GRID_AFTER = '[grid]\ncomponent = true\nclass = "SpectroscopyGrid"\npositions = [["0 nm", "0 nm"]]\nafter = ["{a}"]\n'
PAGE = '[page]\ncomponent = true\nclass = "Dashboard"\n'
CHOOSER = '[choose]\ncomponent = true\nclass = "parts.Chooser"\n'
ANYTHING = '[any]\ncomponent = true\nclass = "parts.Anything"\n'
REAL = FRAME.replace("simulated = true", "")
WIRED = FRAME.partition("[microscope]")[0] + '[microscope]\ncomponent = true\nclass = "parts.Real"\n'
"""A translator of ours, which can be wired to an emulator."""
WITHOUT_SCHEDULER = FRAME[FRAME.index("[microscope]") :]
WITHOUT_TRANSLATOR = FRAME[: FRAME.index("[microscope]")]


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("a = True", "lower case"),
        ("a = None", "leave the line out"),
        ("a = 2 um", ""),
        ("a = Scheduler", "in quotes"),
        ("a = = 3", ""),
        ("a = [1", ""),
        ("a = \u201chello\u201d", "straight"),
        ("a = 1,5", "decimal point"),
        ("a: 3", "after ="),
        ("a:", "in brackets"),
        ('a = "3', "quote that ends"),
        (r'a = "C:\Users\me"', "single quotes"),
        (r'a = ["C:\data"]', "single quotes"),
        ("a = 1\na = 2", "there already"),
        ("a = { x = 1,\n  y = 2 }", "stays on one line"),
        ("[my series]", "with a space"),
    ],
)
def test_syntax_of_other_languages_is_an_error_with_the_toml_form(write: Write, line: str, hint: str) -> None:
    (finding,) = write(f"{line}\n", frame="").check()
    assert finding.hint == hint or (hint and hint in finding.hint)


@pytest.mark.parametrize("name", ["tip_corrector", "Tip Corrector", "a.b-c", "größe", "x" * 100])
def test_a_name_may_be_any_words(write: Write, name: str) -> None:
    assert write(CORRECTOR.replace("repair", f'"{name}"')).check() == []


def test_an_experiment_that_fits_together_has_no_findings(write: Write) -> None:
    assert write(CLASSIFIER + CORRECTOR + PEAKS + CHOOSER).check() == []


@pytest.mark.parametrize("scheduler", ["", '[scheduler]\ncomponent = true\nclass = "Schedular"\n'])
def test_a_missing_scheduler_is_the_only_error(write: Write, scheduler: str) -> None:
    drift = '[pictures]\ncomponent = true\nclass = "DriftPictures"\n'
    assert "schedul" in only_error(write(scheduler + CLASSIFIER + drift, frame=WITHOUT_SCHEDULER)).what


def test_scheduler_table_without_component_true_is_named(write: Write) -> None:
    table = '[scheduler]\nclass = "Scheduler"\n'
    experiment = write(table, frame=WITHOUT_SCHEDULER)
    (error,) = errors(experiment)
    assert (error.what, error.hint) == ("there is no scheduler", "[scheduler] needs `component = true`")
    assert error.place.line == line_of(experiment, "[scheduler]")


BROKEN = {
    "no scheduler": ("", WITHOUT_SCHEDULER, "there is no scheduler"),
    "no translator": ("", WITHOUT_TRANSLATOR, "there is no translator"),
    "two schedulers": ('[second]\ncomponent = true\nrole = "scheduler"\ncommand = ["python3"]\n', FRAME, "a second"),
    "two translators": (
        '[second]\ncomponent = true\nclass = "parts.Simulated"\n',
        FRAME,
        "a second translator",
    ),
    "a name with a dot": (PEAKS.replace("peaks", "my.peaks", 1), FRAME, "[my.peaks] is within a table"),
    "two of one name": (CORRECTOR + CORRECTOR, FRAME, "[repair] is there twice"),
    "names differing in case": (CORRECTOR + CORRECTOR.replace("repair", "Repair"), FRAME, "only in upper and lower"),
    "a name with a slash": (CORRECTOR.replace("repair", '"a/b"'), FRAME, "[a/b] can't be the name"),
    "a name that leads elsewhere": (CORRECTOR.replace("repair", '"../b"'), FRAME, "[../b] can't be the name"),
    "no name": (CORRECTOR.replace("repair", '""'), FRAME, "[] can't be the name"),
    "a name too long": (CORRECTOR.replace("repair", "x" * 101), FRAME, "can't be the name"),
    "not TOML": ("a = = 3\n", FRAME, "not valid TOML"),
    "an unknown section": ("[limts]\nmost_pixels = 3\n", FRAME, "no section [limts]"),
    "an unknown key of a section": ("[clock]\nsped = 2\n", FRAME, "[clock] sped is not a setting"),
    "an unknown role": ('[a]\ncomponent = true\nrole = "shceduler"\ncommand = ["python3"]\n', FRAME, "no role"),
    "class and command": ('[a]\ncomponent = true\nclass = "x.Y"\ncommand = ["python3"]\n', FRAME, "both `class` and"),
    "nothing to run": ("[a]\ncomponent = true\n", FRAME, "neither `class` nor `command`"),
    "not a boolean": ('[a]\ncomponent = "yes"\nclass = "parts.Corrector"\n', FRAME, "not true or false"),
    "no such program": ('[a]\ncomponent = true\ncommand = ["no-such-program"]\n', FRAME, "there is no program"),
    "nobody solves": (CLASSIFIER, FRAME, "which no component solves"),
    "no such problem": (
        '[a]\ncomponent = true\ncommand = ["python3"]\nsolves = ["tip-shape-chnged"]\n',
        FRAME,
        "is not a problem",
    ),
    "a problem's number is taken": ("[problems]\ntip-lost = 4\n", FRAME, "can't have the number 4"),
    "a problem's number is no number": ('[problems]\ntip-lost = "six"\n', FRAME, "not a whole number"),
    "nobody publishes": (ANYTHING + 'envelopes = ["Scn2d"]\n', FRAME, "'Scn2d', which no component publishes"),
    "nobody publishes what a class listens to": (CHOOSER, FRAME, "'PeakList', which no component publishes"),
    "two binds of one address": (
        PEAKS + 'publisher = "tcp://127.0.0.1:9000"\n' + PEAKS.replace("peaks", "more")
        + 'publisher = "tcp://127.0.0.1:9000"\n',
        FRAME,
        "both bind tcp://127.0.0.1:9000",
    ),
    "two binds, one by a wildcard": (
        PEAKS + 'publisher = "tcp://127.0.0.1:9000"\n' + PEAKS.replace("peaks", "more")
        + 'publisher = "tcp://*:9000"\n[security]\ninsecure = true\n',
        FRAME,
        "both bind",
    ),
    "open to the network": (PEAKS + 'publisher = "tcp://192.168.1.5:9000"\n', FRAME, "without keys"),
    "a host that only begins like this computer": (
        PEAKS + 'publisher = "tcp://localhost.example.org:9000"\n', FRAME, "without keys"
    ),
    "a publisher where the log is collected": (
        LOG + 'at = "tcp://127.0.0.1:9000"\n' + PEAKS + 'publisher = "tcp://localhost:9000"\n',
        FRAME,
        "[log] and [peaks] both bind tcp://127.0.0.1:9000 (at, publish)",
    ),
    "a page where the log is collected": (
        PAGE + "port = 9000\n" + LOG + 'at = "tcp://127.0.0.1:9000"\n', FRAME, "(at, port)"
    ),
    "a page at all addresses where somebody publishes": (
        PAGE + 'host = "0.0.0.0"\nport = 9000\n' + PEAKS + 'publisher = "tcp://127.0.0.1:9000"\n', FRAME, "both bind"
    ),
    "an emulated controller where somebody publishes": (
        '[controller]\ncomponent = true\nclass = "AsylumEmulator"\nport = 9000\n'
        + PEAKS + 'publisher = "tcp://127.0.0.1:9000"\n',
        FRAME,
        "both bind",
    ),
    "two emulated controllers": (
        '[one]\ncomponent = true\nclass = "parts.Emulated"\n[two]\ncomponent = true\nclass = "parts.Emulated"\n',
        WIRED,
        "[two] is a second emulated controller beside [one]",
    ),
    "a component of one's own where somebody publishes": (
        '[mine]\ncomponent = true\nclass = "parts.Listener"\n' + PEAKS + 'publisher = "tcp://127.0.0.1:9010"\n',
        FRAME,
        "[mine] and [peaks] both bind tcp://127.0.0.1:9010 (at, publish)",
    ),
    "a log that others on the network can send to": (
        LOG + 'at = "tcp://192.168.1.5:9010"\n', FRAME, "[log] binds tcp://192.168.1.5:9010, which other"
    ),
    "a log at no address": (LOG + 'at = "localhost"\n', FRAME, "this is not an address"),
    "a log at no port": (LOG + 'at = "tcp://127.0.0.1:99999"\n', FRAME, "this is not an address"),
    "a page at no port": (PAGE + "port = 99999\n", FRAME, "this is not a port"),
    "no port": (PEAKS + 'publisher = "tcp://127.0.0.1:99999"\n', FRAME, "neither an address"),
    "no port in an intermediary": (
        ANYTHING + 'subscriber = "s"\n[s]\nclass = "Subscriber"\nsub_url = "tcp://localhost:65536"\n',
        FRAME,
        "is not an address",
    ),
    "nobody binds": (ANYTHING + 'subscriber = "tcp://127.0.0.1:9009"\n', FRAME, "which no process binds"),
    "not an address": (
        ANYTHING + 'subscriber = "s"\n[s]\nclass = "Subscriber"\nsub_url = "localhost:3"\n', FRAME, "is not an address"
    ),
    "an unknown setting of an intermediary": (
        ANYTHING + 'control_client = "c"\n[c]\nclass = "Client"\nretries = 3\n', FRAME, "no setting 'retries'"
    ),
    "a wire of the wrong kind": (
        ANYTHING + 'subscriber = "c"\n[c]\nclass = "Client"\n', FRAME, "is a control client, not a subscriber"
    ),
    "a misspelt intermediary": (
        ANYTHING + 'subscriber = "subb"\n', FRAME, "neither an address nor one of the tables"
    ),
    "to itself by its address": (
        PEAKS + 'publisher = "tcp://127.0.0.1:9000"\nsubscriber = "tcp://127.0.0.1:9000"\n', FRAME, "to itself"
    ),
    "to itself by its name": (PEAKS + 'listens_to = ["peaks"]\n', FRAME, "subscribes to itself"),
    "to somebody unknown": (ANYTHING + 'listens_to = ["peak"]\n' + PEAKS, FRAME, "no component 'peak'"),
    "begins after itself": (GRID_AFTER.format(a="grid"), FRAME, "circle: grid after grid"),
    "begins in a circle": (
        GRID_AFTER.format(a="grid_b") + GRID_AFTER.format(a="grid").replace("[grid]", "[grid_b]"),
        FRAME, "circle: grid after grid_b after grid",
    ),
    "begins after nothing": (GRID_AFTER.format(a="gird"), FRAME, "no component 'gird'"),
    "begins after what never ends": (GRID_AFTER.format(a="scheduler"), FRAME, "no plan, and never done"),
    "begins after the end": (
        GRID_AFTER.format(a="grid_b")
        + GRID_AFTER.replace("[grid]", "[grid_b]").replace('after = ["{a}"]', "end_when_done = true"),
        FRAME, "ends the experiment when it is done",
    ),
    "no plan begins after a plan": (
        '[meta]\ncomponent = true\nclass = "Metadata"\nafter = ["meta"]\n', FRAME, "handles messages from the start on"
    ),
    "to somebody silent": (ANYTHING + 'listens_to = ["repair"]\n' + CORRECTOR, FRAME, "publishes nothing"),
    "time made faster": ("[clock]\nspeed = 60\n", REAL, "not simulated"),
    "time set": ("[clock]\nstart = 2026-01-01T00:00:00Z\n", REAL, "[clock] start"),
    "an unknown person": ('[control.roles]\nset_mode = ["nobdy"]\n', FRAME, "there is no 'nobdy'"),
    "no such folder of keys": ('[security]\nkeys = "keys"\n', FRAME, "there is no folder"),
    "a lease of no time": ('[control]\nlease = "0 s"\n', FRAME, "[control] lease"),
    "a rule of the cache that fits nothing": (
        '[[cache.rules]]\nabove = "2 um"\nup_to = "1 um"\n', FRAME, "above must be less than up_to"
    ),
    "an envelope that does not say what is in it": (
        '[[cache.rules]]\nmessage = "Scan2d"\nenvelope = "wide_{channel}"\n', FRAME, "no subscriber could"
    ),
    "a mapping that does not say what is in it": ('[cache]\nmapping = "parts.mute"\n', FRAME, "no subscriber could"),
    "a mapping that fails": ('[cache]\nmapping = "parts.narrow"\n', FRAME, "[cache] mapping"),
    "a mapping that is not there": ('[cache]\nmapping = "parts.no_such"\n', FRAME, "[cache] mapping"),
}  # fmt: skip


@pytest.mark.parametrize(
    "text",
    [
        PEAKS + 'publisher = "inproc://peaks"\n',
        ANYTHING + 'subscriber = "s"\n[s]\nclass = "Subscriber"\nsub_url = "inproc://peaks"\n',
        LOG + 'at = "inproc://log"\n',
    ],
)
def test_the_refusal_of_an_in_process_address_says_why(write: Write, text: str) -> None:
    assert "inproc:// stays within one process" in only_error(write(text)).hint


EMULATED = '[clock]\nspeed = 60\n[controller]\ncomponent = true\nclass = "parts.Emulated"\n'


def test_time_may_be_faster_with_an_emulated_controller(write: Write) -> None:
    assert errors(write(EMULATED, frame=WIRED)) == []
    assert write(EMULATED, frame=WIRED).resolved.simulated


def test_an_emulator_in_the_file_proves_nothing_of_a_translator_that_is_not_wired_to_it(write: Write) -> None:
    of_another_language = write(EMULATED, frame=REAL)
    assert not of_another_language.resolved.simulated
    assert any("not simulated" in error for error in map(str, errors(of_another_language)))


def test_processes_started_without_the_emulator_are_not_simulated(write: Write) -> None:
    experiment = write(EMULATED, frame=WIRED)
    assert experiment.simulated()
    assert not experiment.simulated(without=["controller"])
    assert not experiment.simulated(only=["scheduler"])
    started = experiment.launches(take_address=lambda: "tcp://127.0.0.1:20000", without=["controller"])
    launch = next(start.launch for start in started if start.launch.name == "microscope")
    assert (launch.simulated, launch.controller) == (False, "")


def test_a_translator_is_wired_to_the_emulator_that_is_started_with_it(write: Write) -> None:
    experiment = write(EMULATED, frame=WIRED)
    started = {s.launch.name: s.launch for s in experiment.launches(take_address=lambda: "tcp://127.0.0.1:20000")}
    assert started["microscope"].controller == "controller"
    assert all(launch.simulated for launch in started.values())


def test_address_beside_an_emulator_is_a_warning(write: Write) -> None:
    found = write(EMULATED, frame=WIRED + 'address = "127.0.0.1:6501"\n').check()
    assert sum("[microscope] address is not used" in finding.what for finding in found) == 1


def test_component_that_listens_at_its_own_address_is_no_error(write: Write) -> None:
    """A page has its own passwords, and each free port is used once."""
    listening = PAGE + 'host = "0.0.0.0"\nport = 9000\n' + PAGE.replace("page", "second") + "port = 0\n"
    listening += LOG + 'at = "tcp://127.0.0.1:9001"\n' + PEAKS + 'publisher = "tcp://127.0.0.1:9002"\n'
    assert errors(write(listening)) == []


@pytest.mark.parametrize("secure", ['[security]\nkeys = "."\n', "[security]\ninsecure = true\n"])
def test_log_may_be_collected_from_other_computers_with_keys_or_insecure(write: Write, secure: str) -> None:
    assert errors(write(LOG + 'at = "tcp://192.168.1.5:9010"\n' + secure)) == []


def test_port_that_is_too_high_is_an_error(write: Write) -> None:
    assert "65535" in only_error(write(PEAKS + 'publisher = "tcp://127.0.0.1:99999"\n')).hint
    assert "65535" in only_error(write(LOG + 'at = "tcp://127.0.0.1:99999"\n')).hint
    assert errors(write(PEAKS + 'publisher = "tcp://127.0.0.1:65535"\n')) == []


def test_lines_of_running_scans_are_published_unless_live_lines_s_is_zero(write: Write) -> None:
    simulated = FRAME[: FRAME.index("[microscope]")] + '[microscope]\ncomponent = true\nclass = "Simulator"\n'
    watcher = ANYTHING + 'envelopes = ["ScanLines"]\n'
    error = only_error(write(watcher, frame=simulated + "live_lines_s = 0\n"))
    assert "'ScanLines', which no component publishes" in error.what
    assert "live_lines_s" in error.hint
    for frame in (simulated, simulated + 'live_lines_s = "1 s"\n'):
        assert errors(write(watcher, frame=frame)) == []


@pytest.mark.parametrize("case", BROKEN, ids=str)
def test_mismatch_between_parts_is_an_error(write: Write, case: str) -> None:
    text, frame, said = BROKEN[case]
    assert said in only_error(write(text, frame=frame)).what


def test_an_error_names_the_line_and_the_nearest_name(write: Write) -> None:
    experiment = write(ANYTHING + 'envelopes = [\n  "Scan2d",\n  "ScopeStatMsg",\n]\n')
    error = only_error(experiment)
    assert error.place.line == line_of(experiment, '  "ScopeStat')
    assert "'ScopeStateMsg'" in error.hint


def test_a_scan_s_envelope_may_be_given_whole(write: Write) -> None:
    assert not errors(write(ANYTHING + 'envelopes = ["Scan2d_2000.0_Height", "Spec1d_IV", "Control"]\n'))


def test_an_envelope_that_a_rule_of_the_cache_makes_is_published(write: Write) -> None:
    rule = '[[cache.rules]]\nmessage = "Scan2d"\nabove = "1 um"\nenvelope = "Scan2d_wide_{channel}"\n'
    assert not errors(write(ANYTHING + 'envelopes = ["Scan2d_wide_Height"]\n' + rule))
    assert errors(write(ANYTHING + 'envelopes = ["wdie_Height"]\n' + rule))


def test_valid_cache_mapping_has_no_finding(write: Write) -> None:
    assert not errors(write('[cache]\nmapping = "parts.wide"\n'))


def test_a_problem_that_a_person_solves_may_be_flagged(write: Write) -> None:
    assert not errors(write(CLASSIFIER + '[control]\nsolved_by_hand = ["EP_TIP_SHAPE_CHANGED"]\n'))


def test_a_problem_that_ends_the_experiment_needs_no_solver(write: Write) -> None:
    assert not errors(write(CLASSIFIER + '[control]\nend_on = ["tip-shape-changed"]\n'))
    (error,) = errors(write(CLASSIFIER + '[control]\nend_on = ["tip-shape-changed", "tip-shape"]\n'))
    assert "'tip-shape' is not a problem" in str(error)


def test_a_problem_named_in_the_file_is_one(write: Write) -> None:
    text = '[a]\ncomponent = true\ncommand = ["python3"]\nsolves = ["tip lost"]\n[problems]\ntip-lost = 10\n'
    experiment = write(text)
    assert not errors(experiment)
    assert experiment.resolved.named_problems == {"tip-lost": 10}


def test_insecure_allows_open_addresses(write: Write) -> None:
    assert not errors(write(PEAKS + 'publisher = "tcp://*:9000"\n[security]\ninsecure = true\n'))


def test_roles_without_keys_are_a_warning(write: Write) -> None:
    roles = CORRECTOR + '[control.roles]\nend_experiment = ["repair"]\n'
    for more, told in (("", False), ("[security]\ninsecure = true\n", True)):
        experiment = write(roles + more)
        assert not errors(experiment)
        assert any("without keys" in f.what for f in experiment.check()) is told


@pytest.mark.parametrize("class_", ["Dashboard", "Gateway"])
def test_role_of_a_person_without_a_password_is_a_warning(write: Write, class_: str) -> None:
    roles = f'[web]\ncomponent = true\nclass = "{class_}"\n{{}}[control.roles]\nset_mode = ["web:Ada"]\n'
    people = f'people.Ada = "scrypt:{"A" * 24}:{"A" * 44}"\n'
    for more, told in (("", True), (people, False), (people.replace("Ada", "Max"), True)):
        found = write(CORRECTOR + roles.format(more)).check()
        assert any("has no password" in finding.what for finding in found) is told


def test_a_text_that_is_nearly_a_variable_is_a_warning(write: Write) -> None:
    experiment = write('channel_id = "Height"\n' + ANYTHING + 'channel = "chanel_id"\n')
    assert not errors(experiment)
    (warning,) = [f for f in experiment.check() if "nearly" in f.what]
    assert "'channel_id'" in warning.hint
    assert warning.place.line == line_of(experiment, "channel =")


def test_unused_intermediary_is_a_warning(write: Write) -> None:
    experiment = write('[sub]\nclass = "Subscriber"\n')
    assert not errors(experiment)
    assert any("nothing refers to [sub]" in f.what for f in experiment.check())


def test_missing_file_is_an_error(tmp_path: Path) -> None:
    error = only_error(load(tmp_path / "none.toml"))
    assert "can't be read" in error.what


def test_missing_part_is_not_reported_if_a_file_is_unreadable(tmp_path: Path) -> None:
    (tmp_path / "night.toml").write_text("a = [1\n")
    (tmp_path / "other.toml").write_text("[clock]\nspeed = 2.0\n")
    (finding,) = load(tmp_path / "night.toml", tmp_path / "other.toml").check()
    assert "not valid TOML" in finding.what


def test_a_file_that_is_no_text_is_an_error(tmp_path: Path) -> None:
    file = tmp_path / "night.toml"
    file.write_bytes(b"\xff\xfe\x00")
    assert "not UTF-8" in only_error(load(file)).what


def test_a_byte_order_mark_does_not_matter(tmp_path: Path, write: Write) -> None:
    experiment = write(CORRECTOR)
    file = experiment.folder / "night.toml"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert not errors(load(file))


def test_expanded_file_has_the_findings_of_the_original(write: Write) -> None:
    experiment = write('where = ["1 um", "1 um"]\n[scan]\ncomponent = true\nclass = "parts.Scanner"\nsize = "where"\n'
        + PEAKS + 'listens_to = []\n[limits]\nmost_pixels = 1000\n')  # fmt: skip
    again = _reload(experiment)
    assert not errors(again)
    for name, process in experiment.resolved.processes.items():
        assert again.resolved.processes[name].settings == process.settings
    assert again.resolved.limits.most_pixels == 1000


def _reload(experiment: Experiment) -> Experiment:
    file = experiment.folder / "expanded.toml"
    file.write_text(experiment.expanded(), encoding="utf-8")
    return load(file)


MAP = 'component = true\nclass = "Adaptive"\nsize = ["1 um", "1 um"]\nquantity = "gap"\nuntil = { spectra = 9 }\n'


def test_a_second_recorder_is_an_error(write: Write) -> None:
    recorder = 'component = true\nclass = "Recorder"\n'
    error = only_error(write(f"[one]\n{recorder}[two]\n{recorder}scans = false\n"))
    assert error.what == "[two] is a second recorder beside [one]"


@pytest.mark.parametrize(
    ("text", "what", "hint"),
    [
        (f"[left]\n{MAP}[right]\n{MAP}", "[right] writes map.csv, which [left] writes, too", 'file = "right"'),
        (f"[left]\n{MAP}[right]\n{MAP}file = 'Map'\n", "[right] writes Map.csv, which [left] writes", 'file = "right"'),
        (
            '[logs]\ncomponent = true\nclass = "LogCollector"\nfile = "log.txt"\n',
            "[logs] writes log.txt, which afspm writes in every run",
            'file = "logs.txt"',
        ),
    ],
)
def test_two_components_that_write_the_same_file_are_an_error(write: Write, text: str, what: str, hint: str) -> None:
    error = only_error(write(text))
    assert what in error.what
    assert hint in error.hint


def test_two_components_may_write_the_same_file_in_two_runs(write: Write) -> None:
    experiment = write(f"[left]\n{MAP}[right]\n{MAP}")
    assert not experiment.check(without=["left"])
    assert not experiment.check(only=["left", "scheduler", "microscope"])


def test_components_of_one_class_write_files_of_their_own(write: Write) -> None:
    assert not errors(write(f"[left]\n{MAP}[right]\n{MAP}file = 'right'\n"))


def test_paths_of_an_overlay_in_another_folder_are_the_same_in_the_expanded_file(write: Write, tmp_path: Path) -> None:
    scanner = '[scan]\ncomponent = true\nclass = "parts.Scanner"\nsize = ["1 um", "1 um"]\n'
    command = '[own]\ncomponent = true\ncommand = ["python3"]\nread = "./first.txt"\n'
    write(scanner + command)
    lab = tmp_path / "lab"
    (lab / "keys").mkdir(parents=True)
    (lab / "own.proto").touch()
    text = (
        'messages = ["own.proto"]\n[scan]\nimage = "tip.png"\n[own]\nmore = "./more.txt"\n[security]\nkeys = "keys"\n'
    )
    (lab / "over.toml").write_text(text, encoding="utf-8")

    def paths(experiment: Experiment) -> list[object]:
        resolved = experiment.resolved
        scan, own = (resolved.processes[name].settings for name in ("scan", "own"))
        return [scan["image"], own["read"], own["more"], *resolved.messages, str(resolved.keys_folder)]

    begun = load(tmp_path / "night.toml", lab / "over.toml")
    (tmp_path / "run.toml").write_text(begun.expanded(), encoding="utf-8")
    files = [lab / "tip.png", tmp_path / "first.txt", lab / "more.txt", lab / "own.proto", lab / "keys"]
    assert paths(begun) == list(map(str, files))
    assert paths(load_expanded(tmp_path / "run.toml", begun.folders)) == paths(begun)


@pytest.mark.skipif(sys.platform == "win32", reason="any file is executable there")
@pytest.mark.parametrize("name", ["own.sh", "./own.sh"])
def test_a_program_beside_the_file_is_run_from_there(write: Write, tmp_path: Path, name: str) -> None:
    text = f'[a]\ncomponent = true\ncommand = ["{name}"]\n[notify]\ncommand = ["{name}", "ada"]\n'
    program = tmp_path / "own.sh"
    program.write_text("#!/bin/sh\n", encoding="utf-8")
    assert {finding.hint for finding in errors(write(text))} == {NO_PROGRAM}
    program.chmod(0o755)
    experiment = write(text)
    assert not errors(experiment)
    starts = {start.launch.name: start for start in experiment.launches(take_address=lambda: "tcp://127.0.0.1:5555")}
    assert starts["a"].command == (str(program),)
    assert starts["notifier"].launch.settings["program"] == [str(program), "ada"]


def test_variable_that_nothing_uses_is_a_warning(write: Write) -> None:
    experiment = write(
        'name = "night"\nchannels = "Height"\nsize_of = 3\ninclude = ["a.toml"]\n' + ANYTHING + 'channel = "channels"\n'
    )
    assert not errors(experiment)
    found = {finding.what: finding for finding in experiment.check()}
    assert set(found) == {"nothing uses the variable 'include'", "nothing uses the variable 'size_of'"}
    assert "afspm run first.toml second.toml" in found["nothing uses the variable 'include'"].hint
    assert found["nothing uses the variable 'size_of'"].place.line == line_of(experiment, "size_of")


def test_variable_that_replaces_a_choice_of_a_setting_is_a_warning(write: Write) -> None:
    series = '[series]\ncomponent = true\nclass = "ScanSeries"\nsize = ["1 um", "1 um"]\nmissed = "extend"\n'
    (warning,) = write('extend = "skip"\n' + series).check()
    assert warning.what == "[series] missed = 'extend' is replaced by 'skip', the value of the variable 'extend'"
    assert write('later = "skip"\n' + series.replace("extend", "later")).check() == []


@pytest.mark.parametrize(
    ("frame", "more", "warns"), [(FRAME, "", False), (REAL, "", True), (REAL, "[limits]\n", False)]
)
def test_treatment_of_a_real_tip_without_limits_is_a_warning(
    write: Write, frame: str, more: str, *, warns: bool
) -> None:
    repair = '[repair]\ncomponent = true\nclass = "TipCorrector"\nworkshop_center = ["8 um", "0 um"]\n'
    found = write(repair + CLASSIFIER + more, frame=frame).check()
    assert any("on a microscope that is not simulated, without [limits]" in one.what for one in found) is warns


def test_bare_name_of_a_class_is_the_remedy_of_a_wrong_path(write: Write) -> None:
    error = only_error(write('[series]\ncomponent = true\nclass = "afspm.components.ScanSeries"\n'))
    assert error.hint == 'write class = "ScanSeries"'


def test_line_that_is_not_utf_8_is_named(tmp_path: Path) -> None:
    file = tmp_path / "night.toml"
    file.write_bytes("a = 1\n# größe\n".encode("latin-1"))
    error = only_error(load(file))
    assert (error.place.line, error.hint) == (2, 'save it as "UTF-8" in your editor')


SERIES = '[series]\ncomponent = {on}\nclass = "ScanSeries"\nsize = ["1 um", "1 um"]\nscans = 3\n'
NOTHING_MEASURES = "nothing measures: no component of this experiment makes requests"


@pytest.mark.parametrize(
    ("text", "hint"),
    [("", "add a component that measures"), (SERIES.format(on="false"), "[series] component = true")],
    ids=["microscope and scheduler", "switched off"],
)
def test_experiment_in_which_nothing_measures_is_a_warning(write: Write, text: str, hint: str) -> None:
    # users N9: it ran for ever, and the check said "nothing wrong"
    (warning,) = write(text).check()
    assert (warning.is_error, warning.what) == (False, NOTHING_MEASURES)
    assert hint in warning.hint


@pytest.mark.parametrize(
    "text",
    [
        SERIES.format(on="true"),
        '[dashboard]\ncomponent = true\nclass = "Dashboard"\n',
        '[gateway]\ncomponent = true\nclass = "Gateway"\n',
        '[own]\ncomponent = true\nclass = "parts.Peaks"\n',
        '[own]\ncomponent = true\ncommand = ["python3", "own.py"]\n',
    ],
)
def test_experiment_whose_components_may_measure_has_no_warning(write: Write, text: str) -> None:
    assert NOTHING_MEASURES not in [one.what for one in write(text).check()]


# faults 6
def test_hostile_file_is_one_error_with_its_place(write: Write) -> None:
    error = only_error(write("a = " + "[" * 60_000 + "]" * 60_000 + "\n"))
    assert error.what == "not valid TOML: tables and lists are nested more than 50 deep"


def test_commands_to_the_terminal_are_escaped_in_findings(write: Write) -> None:
    found = errors(write('["\\u001b[31mX"]\ncomponent = true\nclass = "Y\\u001b[31m"\n'))
    assert found
    assert not any("\x1b" in f"{one.what}{one.hint}" for one in found)
    assert any("\\x1b[31mX" in one.what for one in found)
