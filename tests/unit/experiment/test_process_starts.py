"""From the file to launch lines: default wiring, the paper's form, partial starts."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Collection
from pathlib import Path

import pytest

from afspm.basics.errors import ConfigError
from afspm.basics.launch import Launch
from afspm.experiment import Experiment, ProcessStart, Role, load
from afspm.transport.keys import generate

from .conftest import FRAME, PYTHON, Write, errors, only_error

CORRECTOR = '[repair]\ncomponent = true\nclass = "parts.Corrector"\n'
PEAKS = '[peaks]\ncomponent = true\nclass = "parts.Peaks"\n'
CHOOSER = '[choose]\ncomponent = true\nclass = "parts.Chooser"\n'
CLASSIFIER = '[watch]\ncomponent = true\nclass = "parts.Classifier"\n'


def counting() -> Callable[[], str]:
    ports = itertools.count(20000)
    return lambda: f"tcp://127.0.0.1:{next(ports)}"


def starts(
    experiment: Experiment, only: Collection[str] = (), without: Collection[str] = ()
) -> dict[str, ProcessStart]:
    found = experiment.launches(take_address=counting(), only=only, without=without, run_dir="run", state_dir="state")
    return {start.launch.name: start for start in found}


def test_wiring_left_out_connects_everything(write: Write) -> None:
    found = starts(write(CORRECTOR))
    translator, scheduler, component = (found[n].launch.sockets for n in ("microscope", "scheduler", "repair"))
    assert None not in {translator.publish, translator.serve, scheduler.publish, scheduler.serve}
    assert len({translator.publish, translator.serve, scheduler.publish, scheduler.serve}) == 4
    assert scheduler.subscribe == (translator.publish,)
    assert scheduler.control == translator.serve
    assert component.subscribe == (scheduler.publish,)
    assert component.control == scheduler.serve
    assert component.publish is None


def test_translator_and_scheduler_come_first(write: Write) -> None:
    found = starts(write(CORRECTOR))
    assert [start.role for start in found.values()] == [
        Role.TRANSLATOR,
        Role.SCHEDULER,
        Role.COMPONENT,
        Role.COMPONENT,
    ]


def test_a_recorder_is_part_of_every_experiment(write: Write) -> None:
    experiment = write(CORRECTOR)
    assert experiment.recorders == ["recorder"]
    launch = starts(experiment)["recorder"].launch
    assert (launch.class_, launch.settings, launch.envelopes) == ("afspm.components.recorder.Recorder", {}, ("",))


def test_file_may_switch_the_recorder_off_or_have_its_own(write: Write) -> None:
    assert set(starts(write(CORRECTOR + "[record]\non = false\n"))) == {"microscope", "scheduler", "repair"}
    own = '[keeper]\ncomponent = true\nclass = "Recorder"\nscans = false\n'
    assert set(starts(write(CORRECTOR + own))) == {"microscope", "scheduler", "repair", "keeper"}
    assert starts(write(CORRECTOR + "[record]\nscans = false\n"))["recorder"].launch.settings == {"scans": False}


NEEDY = """
from afspm import Component
class Needy(Component):
    requires = ("afspm[dashboard]", "no-such-package>=2")
"""


def test_a_class_whose_packages_are_not_installed_is_refused_where_it_is_started(write: Write, tmp_path: Path) -> None:
    (tmp_path / "needy.py").write_text(NEEDY)
    experiment = write(CORRECTOR + '[watcher]\ncomponent = true\nclass = "needy.Needy"\n')
    (finding,) = experiment.check()
    assert finding.is_error
    assert finding.what == "[watcher] class: Needy needs packages that are not installed: no-such-package"
    assert finding.hint == 'pip install "no-such-package>=2"'
    with pytest.raises(ConfigError, match="no-such-package"):
        starts(experiment)
    assert experiment.check(without=["watcher"]) == []
    assert "watcher" not in starts(experiment, without=["watcher"])


def test_a_component_called_recorder_keeps_its_name(write: Write) -> None:
    experiment = write(CORRECTOR.replace("repair", "recorder"))
    assert set(starts(experiment)) == {"microscope", "scheduler", "recorder", "recorder2"}
    assert experiment.recorders == ["recorder2"]


def test_the_recorder_is_started_where_the_scheduler_is(write: Write) -> None:
    addresses = '[microscope]\npublisher = "tcp://127.0.0.1:9000"\ncontrol_server = "tcp://127.0.0.1:9001"\n'
    scheduler = '[scheduler]\npubsubcache = "tcp://127.0.0.1:9002"\nrouter = "tcp://127.0.0.1:9003"\n'
    experiment = write(PEAKS, addresses + scheduler)
    assert set(starts(experiment, only=["scheduler"])) == {"scheduler", "recorder"}
    assert set(starts(experiment, only=["peaks"])) == {"peaks"}
    assert set(starts(experiment, only=["recorder"])) == {"recorder"}
    assert set(starts(experiment, without=["recorder"])) == {"microscope", "scheduler", "peaks"}
    # where peaks publishes is not written down, and need not be for the recorder's sake
    assert starts(experiment, only=["scheduler"])["recorder"].launch.sockets.subscribe == ("tcp://127.0.0.1:9002",)


def test_the_expanded_file_has_the_recorder_and_means_the_same(write: Write, tmp_path: Path) -> None:
    text = write(CORRECTOR).expanded()
    (tmp_path / "again.toml").write_text(text, encoding="utf-8")
    assert load(tmp_path / "again.toml").component_names == write(CORRECTOR).component_names
    assert load(tmp_path / "again.toml").recorders == ["recorder"]


def test_subscriber_of_a_component_s_envelope_is_connected_to_it(write: Write) -> None:
    found = starts(write(PEAKS + CHOOSER + CORRECTOR + CLASSIFIER))
    peaks = found["peaks"].launch.sockets.publish
    assert peaks is not None
    assert peaks in found["choose"].launch.sockets.subscribe
    assert peaks in found["repair"].launch.sockets.subscribe  # it does not say what it listens to: everything
    assert peaks not in found["watch"].launch.sockets.subscribe
    assert peaks not in found["peaks"].launch.sockets.subscribe


def test_listens_to_names_the_publishers_to_connect_to(write: Write) -> None:
    text = PEAKS + PEAKS.replace("peaks", "more") + CHOOSER + 'listens_to = ["more"]\n'
    found = starts(write(text))
    sources = found["choose"].launch.sockets.subscribe
    assert found["more"].launch.sockets.publish in sources
    assert found["peaks"].launch.sockets.publish not in sources


def test_envelopes_are_those_of_the_file_else_of_the_class_else_all(write: Write) -> None:
    found = starts(write(PEAKS + CHOOSER + CORRECTOR + CLASSIFIER + 'envelopes = ["ControlState"]\n'))
    assert found["watch"].launch.envelopes == ("ControlState",)
    assert found["choose"].launch.envelopes == ("PeakList",)
    assert found["repair"].launch.envelopes is None


def test_a_wildcard_is_connected_to_by_the_loopback(write: Write) -> None:
    experiment = write(PEAKS + 'publisher = "tcp://*:9000"\n' + CHOOSER + "[security]\ninsecure = true\n")
    found = starts(experiment)
    assert found["peaks"].launch.sockets.publish == "tcp://*:9000"
    assert "tcp://127.0.0.1:9000" in found["choose"].launch.sockets.subscribe


def test_a_command_gets_its_settings_and_the_folder_of_the_file(write: Write) -> None:
    experiment = write(
        '[other]\ncomponent = true\ncommand = ["python3", "x.py"]\nthreshold = 0.5\nlistens = ["Scan2d"]\n'
    )
    start = starts(experiment)["other"]
    assert start.command[1:] == ("x.py",)
    assert start.folder == experiment.folder
    assert start.launch.settings == {"threshold": 0.5}
    assert start.launch.envelopes == ("Scan2d",)


def test_launch_line_is_complete(write: Write) -> None:
    experiment = write(CORRECTOR + 'voltage = "250 mV"\n[problems]\ntip-lost = 9\n[control]\nrequest_timeout = "2 s"\n')
    launch = starts(experiment)["repair"].launch
    assert launch.class_ == "parts.Corrector"
    assert launch.settings == {"voltage": 0.25}
    assert launch.problems == {"tip-lost": 9}
    assert launch.request_timeout_s == 2.0
    assert (launch.run_dir, launch.state_dir) == ("run", "state")
    assert launch.simulated
    assert Launch.from_json(launch.to_json()) == launch
    assert str(experiment.folder) in starts(experiment)["repair"].python_path


def test_scheduler_gets_the_sections_to_enforce(write: Write) -> None:
    text = (
        CORRECTOR + '[control]\nlease = "10 min"\nstop_scan_on_manual = false\n'
        '[limits]\nregion = { x = ["0 um", "1 um"], y = ["0 um", "1 um"] }\n'
        '[limits.scan-speed]\nmax = "1 um/s"\n[cache]\nhistory = { Scan2d = 7 }\n'
    )
    launch = starts(write(text))["scheduler"].launch
    assert launch.settings["control"]["lease_s"] == 600.0
    assert launch.settings["control"]["stop_scan_on_manual"] is False
    assert launch.settings["limits"]["parameters"]["scan-speed"]["high"] == pytest.approx(1e-6)
    assert launch.settings["limits"]["region"]["size_m"] == pytest.approx([1e-6, 1e-6])
    assert launch.settings["cache"]["history"] == {"Scan2d": 7}
    assert Launch.from_json(launch.to_json()) == launch


def test_scheduler_and_translator_get_the_adjustable_parameters(write: Write) -> None:
    started = starts(write(CORRECTOR + '[control]\nadjustable = ["zctrl-setpoint"]\n'))
    assert started["scheduler"].launch.settings["control"]["adjustable"] == ["zctrl-setpoint"]
    assert started["microscope"].launch.adjustable == ("zctrl-setpoint",)
    assert started["repair"].launch.adjustable == ()
    with pytest.raises(ConfigError, match="adjustable"):
        starts(write(CORRECTOR + '[control]\nadjustable = ["scan-size-x"]\n'))


def test_a_file_with_errors_starts_nothing(write: Write) -> None:
    with pytest.raises(ConfigError, match="no setting 'volage'"):
        starts(write(CORRECTOR + "volage = 3\n"))


def test_only_and_without_choose_processes(write: Write) -> None:
    experiment = write(CORRECTOR + CLASSIFIER)
    assert set(starts(experiment, without=["watch"])) == {"microscope", "scheduler", "repair", "recorder"}
    with pytest.raises(ConfigError, match="no component 'repiar'"):
        starts(experiment, only=["repiar"])


def test_component_that_was_left_out_has_no_subscribers(write: Write) -> None:
    experiment = write(PEAKS + CHOOSER)
    found = starts(experiment, without=["peaks"])
    assert found["choose"].launch.sockets.subscribe == (found["scheduler"].launch.sockets.publish,)


def test_a_piecemeal_start_needs_the_addresses_in_the_file(write: Write) -> None:
    for here in (["repair"], ["microscope", "scheduler"]):
        with pytest.raises(ConfigError, match=r"\[scheduler\] pubsubcache \(for repair\)") as refused:
            starts(write(CORRECTOR), only=here)
        assert "[scheduler] router (for repair)" in refused.value.what


FIXED = FRAME.replace(
    'role = "scheduler"',
    'role = "scheduler"\npubsubcache = "tcp://127.0.0.1:9001"\nrouter = "tcp://127.0.0.1:9002"',
)


def test_a_piecemeal_start_with_the_addresses_in_the_file(write: Write) -> None:
    here = starts(write(CORRECTOR, frame=FIXED), only=["repair"])
    there = starts(write(CORRECTOR, frame=FIXED), only=["microscope", "scheduler"])
    assert here["repair"].launch.sockets.subscribe == (there["scheduler"].launch.sockets.publish,)
    assert here["repair"].launch.sockets.control == there["scheduler"].launch.sockets.serve


def test_keys_name_the_owner_at_each_address(write: Write, tmp_path: Path) -> None:
    generate(tmp_path / "keys", ["microscope", "scheduler", "repair"])
    experiment = write(CORRECTOR + '[security]\nkeys = "keys"\n')
    assert not errors(experiment)
    launch = starts(experiment)["repair"].launch
    assert launch.keys is not None
    assert Path(launch.keys["folder"]) == tmp_path / "keys"
    assert launch.keys[launch.sockets.subscribe[0]] == "scheduler"
    assert launch.sockets.control is not None
    assert launch.keys[launch.sockets.control] == "scheduler"


PAPER = f"""
pub_url = "tcp://127.0.0.1:9000"
psc_url = "tcp://127.0.0.1:9001"
server_url = "tcp://127.0.0.1:6666"
router_url = "tcp://127.0.0.1:6667"
request_timeout_ms = 1500
topics = ["Scan2d", "ScopeStateMsg"]

[scan_logic]
class = 'afspm.io.pubsub.logic.pbc_logic.PBCScanLogic'
default_scan_history = 4
proto_with_history_list = 'sizes'

[sizes]
class = 'afspm.io.pubsub.logic.pbc_logic.create_roi_proto_hist_list'
sizes_with_hist_list = [[[200, 200], 1], [['40 nm', '40 nm'], 9]]

[cache_kwargs]
cache_logic = 'scan_logic'

[pub]
class = 'afspm.io.pubsub.publisher.Publisher'
url = 'pub_url'

[psc]
class = 'afspm.io.pubsub.cache.PubSubCache'
url = 'psc_url'
sub_url = 'pub_url'
update_cache_kwargs = 'cache_kwargs'

[sub]
class = 'afspm.io.pubsub.subscriber.Subscriber'
sub_url = 'psc_url'
topics_to_sub = 'topics'

[server]
class = 'afspm.io.control.server.ControlServer'
url = 'server_url'

[router]
class = 'afspm.io.control.router.ControlRouter'
server_url = 'server_url'
router_url = 'router_url'

[client]
class = 'afspm.io.control.client.ControlClient'
url = 'router_url'
request_timeout_ms = 'request_timeout_ms'
request_retries = 0

[repair]
component = true
class = 'parts.Corrector'
subscriber = 'sub'
control_client = 'client'

[mediator]
component = true
command = [{PYTHON}]
pubsubcache = 'psc'
router = 'router'

[translator]
component = true
command = [{PYTHON}]
publisher = 'pub'
control_server = 'server'
subscriber = 'sub'
"""


def test_the_paper_s_form_is_understood(write: Write) -> None:
    experiment = write(PAPER, frame="")
    assert not errors(experiment)
    found = starts(experiment)
    translator, scheduler, component = (found[n].launch for n in ("translator", "mediator", "repair"))
    assert (translator.sockets.publish, translator.sockets.serve) == ("tcp://127.0.0.1:9000", "tcp://127.0.0.1:6666")
    assert (scheduler.sockets.publish, scheduler.sockets.serve) == ("tcp://127.0.0.1:9001", "tcp://127.0.0.1:6667")
    assert scheduler.sockets.subscribe == (translator.sockets.publish,)
    assert scheduler.sockets.control == translator.sockets.serve
    assert component.sockets.subscribe == (scheduler.sockets.publish,)
    assert component.sockets.control == scheduler.sockets.serve
    assert component.envelopes == ("Scan2d", "ScopeStateMsg")
    assert (component.request_timeout_s, component.request_retries) == (1.5, 0)
    assert component.settings == {}


def test_the_paper_s_cache_logic_is_understood(write: Write) -> None:
    cache = starts(write(PAPER, frame=""))["mediator"].launch.settings["cache"]
    assert cache["history"] == {"Scan2d": 4}
    assert [(rule["above_m"] < width < rule["up_to_m"], rule["history"]) for rule, width in zip(
        cache["rules"], (200e-9, 40e-9), strict=True)] == [(True, 1), (True, 9)]  # fmt: skip


def test_a_misspelt_variable_of_the_wiring_is_an_error(write: Write) -> None:
    error = only_error(
        write(PAPER.replace("url = 'server_url'\n\n[router]", "url = 'sever_url'\n\n[router]"), frame="")
    )
    assert "'sever_url' is not an address" in error.what
    assert "'server_url'" in error.hint


def test_the_experiment_is_named_by_its_folder_or_file_or_itself(tmp_path: Path) -> None:
    folder = tmp_path / "tip_repair"
    folder.mkdir()
    for file, text, name in (
        ("experiment.toml", "", "tip_repair"),
        ("night.toml", "", "night"),
        ("other.toml", 'name = "My night"', "My night"),
    ):
        (folder / file).write_text(text)
        assert load(folder / file).name == name


def test_user_messages_reach_every_process_as_files_beside_the_experiment(write: Write) -> None:
    text = 'messages = ["crystal.proto", "parts"]\n' + CORRECTOR
    assert "no file 'crystal.proto'" in only_error(write(text)).what
    experiment = write(text)
    (experiment.folder / "crystal.proto").write_text('syntax = "proto3";')
    launch = starts(load(experiment.folder / "night.toml"))["repair"].launch
    assert launch.messages == (str(experiment.folder / "crystal.proto"), "parts")


def test_command_may_declare_that_it_sends_no_heartbeats(write: Write) -> None:
    text = '[other]\ncomponent = true\ncommand = ["python", "x.py"]\n'
    assert starts(write(text))["other"].beats
    start = starts(write(text + "heartbeats = false\n"))["other"]
    assert not start.beats
    assert start.launch.settings == {}
    assert start.command == (sys.executable, "x.py")


def test_components_and_scheduler_keep_requests_if_the_record_does(write: Write) -> None:
    kept = {name: one.launch.keeps_requests for name, one in starts(write(CORRECTOR)).items()}
    assert not any(kept.values())
    kept = {
        name: one.launch.keeps_requests
        for name, one in starts(write(CORRECTOR + "[record]\nrequests = true\n")).items()
    }
    assert kept["repair"]
    assert kept["scheduler"]
    assert not kept["microscope"]
