"""Files of the published implementation are converted, and each line is explained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from afspm.cli.app import app
from afspm.experiment import Experiment, load
from afspm.experiment.published_form.short_form import explained, short

from .conftest import Write, errors, line_of

WIRING = """
pub_url = "tcp://127.0.0.1:9000"
psc_url = "tcp://127.0.0.1:9001"
server_url = "tcp://127.0.0.1:6666"
router_url = "tcp://127.0.0.1:6667"
rescan_url = "tcp://127.0.0.1:9005"
xop_url = "tcp://127.0.0.1:5555"
units = "nm"
origin = [0, 0]
full_size = [200, 200]
small_size = [40, 40]
channel_id = "Topo"
request_timeout_ms = 5000

[full_id]
class = "afspm.io.pubsub.logic.pbc_logic.create_roi_scan_envelope"
size = "full_size"
channel = "channel_id"

[histories]
class = "afspm.io.pubsub.logic.pbc_logic.create_roi_proto_hist_list"
sizes_with_hist_list = [["full_size", 1], ["small_size", 3]]
channels_list = ["channel_id", "channel_id"]

[logic]
class = "afspm.io.pubsub.logic.pbc_logic.PBCScanLogic"
proto_with_history_list = "histories"
default_scan_history = 7

[cache_kwargs]
cache_logic = "logic"

[pub]
class = "afspm.io.pubsub.publisher.Publisher"
url = "pub_url"

[psc]
class = "afspm.io.pubsub.cache.PubSubCache"
url = "psc_url"
sub_url = "pub_url"
update_cache_kwargs = "cache_kwargs"

[sub]
class = "afspm.io.pubsub.subscriber.Subscriber"
sub_url = "psc_url"
extract_proto_kwargs = "cache_kwargs"

[full_sub]
class = "afspm.io.pubsub.subscriber.Subscriber"
sub_url = "psc_url"
topics_to_sub = ["full_id", "ControlState"]

[rescan_pub]
class = "afspm.io.pubsub.publisher.Publisher"
url = "rescan_url"

[rescan_sub]
class = "afspm.io.pubsub.subscriber.Subscriber"
sub_url = "rescan_url"

[server]
class = "afspm.io.control.server.ControlServer"
url = "server_url"

[router]
class = "afspm.io.control.router.ControlRouter"
server_url = "server_url"
router_url = "router_url"
request_timeout_ms = "request_timeout_ms"

[client]
class = "afspm.io.control.client.ControlClient"
url = "router_url"

[ui_client]
class = "afspm.io.control.client.AdminControlClient"
url = "router_url"
"""
METADATA = """
[metadata]
component = true
class = "afspm.components.scan.metadata.ScanMetadataWriter"
subscriber = "sub"
"""
MEDIATOR = """
[mediator]
component = true
class = "afspm.components.microscope.mediator.MicroscopeMediator"
pubsubcache = "psc"
router = "router"
"""
DRIFT = """
[mediator]
component = true
class = "afspm.components.drift.mediator.DriftCompensatedMediator"
pubsubcache = "psc"
router = "router"
publisher = "rescan_pub"
channel_id = "channel_id"
update_weight = 0.8
rescan_intersection_ratio = 0.9
min_intersection_ratio = 0.4
min_spatial_res_ratio = 0.3
display_fit = false

[rescanner]
component = true
class = "afspm.components.drift.rescanner.DriftRescanner"
rerun_wait_s = 5
subscriber = "rescan_sub"
control_client = "client"
"""
PICTURE = """
[translator]
component = true
class = "afspm.components.microscope.translators.image.translator.ImageTranslator"
physical_origin = "origin"
physical_size = "full_size"
physical_units = "units"
data_units = "pixels"
channel_id = "channel_id"
scan_time_s = 2
move_time_s = 1
publisher = "pub"
control_server = "server"
subscriber = "sub"
"""
SHOWN = """
[ui]
component = true
class = "afspm.components.control_ui.AfspmControlUI"
subscriber = "sub"
control_client = "ui_client"

[visualizer]
component = true
class = "afspm.components.visualizer.Visualizer"
subscriber = "sub"
control_client = "ui_client"
list_keys = ["full_id"]
channels_list = ["channel_id"]
cache_meaning_list = ["temporal"]
"""
SERIES = """
[experiment]
component = true
class = "ScanSeries"
subscriber = "sub"
control_client = "client"
size = ["200 nm", "200 nm"]
pixels = [32, 32]
every = "1 min"
"""
SCANNING = """
[data]
class = "experiment.ExperimentData"
scan_origin = "origin"
scan_size = "full_size"
length_units = "units"
scan_res = [256, 128]
scan_wait_s = 5

[experiment]
component = true
class = "afspm.components.scan.handler.ScanningComponent"
subscriber = "sub"
control_client = "client"
rerun_wait_s = 60
get_next_params = "experiment.get_next_scan_params"
next_params_kwargs = { exp_data = "data" }
"""


def published(write: Write, *texts: str) -> Experiment:
    return write(WIRING + "".join(texts), frame="")


def test_a_file_of_the_published_form_can_be_run(write: Write) -> None:
    experiment = published(write, DRIFT, PICTURE, SERIES, SHOWN, METADATA)
    assert errors(experiment) == []
    classes = {
        name: process.class_path.rpartition(".")[2]
        for name, process in experiment.resolved.processes.items()
        if process.class_path
    }
    assert classes["mediator"] == "DriftCompensatedScheduler"
    assert classes["translator"] == "Simulator"
    assert (classes["rescanner"], classes["metadata"], classes["ui"]) == ("Rescanner", "Metadata", "Dashboard")
    assert "visualizer" not in classes, "one dashboard is enough"


def test_settings_of_the_drift_scheduler_are_those_of_the_paper_s_tracker(write: Write) -> None:
    experiment = published(write, DRIFT, PICTURE, SERIES)
    drift = experiment.resolved.processes["mediator"].settings["drift"]
    assert drift["channel"] == "Height", "the simulated channel that stands for the picture's"
    assert drift["tracker"] == {"class": "paper", "w_update": 0.8, "f_min": 0.4, "sr_norm_min": 0.3, "queue": 7}
    assert (drift["rescan"]["rule"], drift["rescan"]["f_rescan"]) == ("paper", 0.9)


MODEL = """
[model]
class = "afspm.components.drift.drift.create_drift_model"
descriptor_type = "afspm.components.drift.drift.DescriptorType.ORB"
transform_type = "EUCLIDEAN"
"""


def test_the_published_drift_model_is_an_estimator(write: Write) -> None:
    text = MODEL + DRIFT.replace("display_fit = false", 'drift_model = "model"')
    experiment = published(write, text, PICTURE, SERIES)
    assert errors(experiment) == []
    drift = experiment.resolved.processes["mediator"].settings["drift"]
    assert drift["estimator"] == {"class": "orb", "transform": "euclidean"}
    assert drift["tracker"]["transform"] == "euclidean"


@pytest.mark.parametrize("line", ['descriptor_type = "SURF"', "scan_res = [128, 128]", 'fitting = "LEAST_SQUARES"'])
def test_a_drift_model_that_is_not_here_is_refused(write: Write, line: str) -> None:
    model = (
        MODEL.replace('transform_type = "EUCLIDEAN"', line)
        if "descriptor" not in line
        else f"""
[model]
class = "afspm.components.drift.drift.create_drift_model"
{line}
"""
    )
    text = model + DRIFT.replace("display_fit = false", 'drift_model = "model"')
    assert errors(published(write, text, PICTURE, SERIES))


@pytest.mark.parametrize(
    ("ours", "published_line"),
    [
        ('tracker = "bank"', "update_weight"),
        ("tracker = { w_update = 0.5 }", "update_weight"),
        ('channel = "Phase"', 'channel_id = "channel_id"'),
    ],
)
def test_afspm_setting_beside_its_published_equivalent_is_refused(write: Write, ours: str, published_line: str) -> None:
    text = DRIFT.replace("display_fit = false", f"drift = {{ {ours} }}")
    experiment = published(write, text, PICTURE, SERIES)
    found = [error for error in errors(experiment) if error.place.line == line_of(experiment, published_line)]
    assert [error.hint for error in found] == ["say one of them"]


def test_afspm_settings_are_added_to_published_ones(write: Write) -> None:
    text = DRIFT.replace("display_fit = false", 'drift = { correct_after = "2 h", tracker = { lost_after = 9 } }')
    experiment = published(write, text, PICTURE, SERIES)
    assert errors(experiment) == []
    drift = experiment.resolved.processes["mediator"].settings["drift"]
    assert (drift["correct_after"], drift["tracker"]["lost_after"], drift["tracker"]["w_update"]) == (7200.0, 9, 0.8)


def test_settings_missing_in_the_published_file_keep_their_defaults(write: Write) -> None:
    plain = DRIFT.split("channel_id")[0] + DRIFT[DRIFT.index("\n[rescanner]") :]
    assert "drift" not in published(write, plain, PICTURE, SERIES).resolved.processes["mediator"].settings


def test_the_drift_scheduler_has_its_equivalent_under_its_first_name(write: Write) -> None:
    first = DRIFT.replace("drift.mediator.DriftCompensatedMediator", "drift.scheduler.CSCorrectedScheduler")
    mediator = published(write, first, PICTURE, SERIES).resolved.processes["mediator"]
    assert mediator.class_path.rpartition(".")[2] == "DriftCompensatedScheduler"
    assert mediator.settings == published(write, DRIFT, PICTURE, SERIES).resolved.processes["mediator"].settings


@pytest.mark.parametrize("line", ["intersection_ratio = 0.8", "correction_history_length = 5"])
def test_setting_of_the_first_drift_scheduler_alone_is_refused(write: Write, line: str) -> None:
    first = DRIFT.replace("drift.mediator.DriftCompensatedMediator", "drift.scheduler.CSCorrectedScheduler")
    experiment = published(write, first.replace("display_fit = false", line), PICTURE, SERIES)
    (error,) = errors(experiment)
    assert (error.place.line, error.what) == (line_of(experiment, line), f"[mediator] {line}: this is not taken over")


@pytest.mark.parametrize(
    ("added", "surface"), [("", "particles"), ('surface = "steps"', "steps")], ids=["left out", "written"]
)
def test_a_drifting_picture_without_a_file_is_a_surface_with_features_in_both_directions(
    write: Write, added: str, surface: str
) -> None:
    drifting = PICTURE.replace(
        '"afspm.components.microscope.translators.image.translator.ImageTranslator"',
        f'"translator.DriftImageTranslator"\n{added}',
    )
    experiment = published(write, MEDIATOR, drifting, SERIES)
    assert errors(experiment) == []
    assert experiment.resolved.processes["translator"].settings["surface"] == surface
    known = {line: became for _, line, became in explained(experiment.resolved)}
    assert ('surface = "particles"' in known["[translator] class"]) is not added
    assert f'surface = "{surface}"' in short(experiment.resolved)


@pytest.mark.parametrize("broken", [0, 1], ids=["base", "overlay"])
def test_nothing_follows_from_a_file_that_is_not_toml(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: int
) -> None:
    texts = [WIRING + MEDIATOR + SERIES, PICTURE + SHOWN.replace("list_keys", "lst_keys")]
    texts[broken] += "again = 1\nagain = 2\n"
    for name, text in zip(("base.toml", "overlay.toml"), texts, strict=True):
        (tmp_path / name).write_text(text, encoding="utf-8")
    files = tmp_path / "base.toml", tmp_path / "overlay.toml"
    (finding,) = load(*files).check(only=["no such component"])
    assert (finding.what[:14], finding.place.file) == ("not valid TOML", str(files[broken]))
    done = CliRunner().invoke(app, ["check", "--explain", *map(str, files)])
    assert (done.exit_code, done.stdout) == (1, "")
    assert done.stderr.count("error: ") == 1


@pytest.mark.parametrize(
    ("name", "settings", "ours", "expected"),
    [
        ("asylum.translator.AsylumTranslator", 'xop_client = "xop"', "Asylum", "tcp://127.0.0.1:5555"),
        ("nanonis.translator.NanonisTranslator", 'client = "nanonis_client"', "Nanonis", "10.0.0.5:6503"),
        ("gxsm.translator.GxsmTranslator", "read_use_physical_units = true", "Gxsm", None),
    ],
)
def test_each_published_translator_has_an_equivalent(
    write: Write, name: str, settings: str, ours: str, expected: str | None
) -> None:
    text = f"""
[xop]
class = "afspm.components.microscope.translators.asylum.client.XopClient"
url = "xop_url"
timeout_s = 20

[nanonis_client]
class = "afspm.components.microscope.translators.nanonis.client.NanonisClient"
host = "10.0.0.5"
port = 6503

[translator]
component = true
class = "afspm.components.microscope.translators.{name}"
publisher = "pub"
control_server = "server"
float_tolerance = 1e-5
{settings}
"""
    experiment = published(write, text, MEDIATOR, SERIES)
    assert errors(experiment) == []
    assert experiment.resolved.processes["translator"].class_path.rpartition(".")[2] == ours
    assert experiment.resolved.processes["translator"].settings.get("address") == expected
    assert experiment.resolved.processes["translator"].settings.get("reply_timeout_s") == (
        20.0 if ours == "Asylum" else None
    )


def test_published_functions_are_evaluated_where_a_topic_names_them(write: Write) -> None:
    experiment = published(write, MEDIATOR, PICTURE, SERIES.replace('"sub"', '"full_sub"'))
    assert errors(experiment) == []
    (part,) = [part for part in experiment.parts.components if part.name == "experiment"]
    assert experiment.resolved.processes[part.name].envelopes == ("Scan2d_200.0_Height", "ControlState")


def test_histories_by_size_and_channel_are_rules_of_the_cache(write: Write) -> None:
    rules = published(write, MEDIATOR, PICTURE, SERIES).resolved.caching.rules
    assert [(rule.channel, rule.history) for rule in rules] == [("Height", 1), ("Height", 3)]


def test_component_that_calls_published_code_is_refused_with_a_replacement(write: Write) -> None:
    analysis = """
[analysis]
component = true
class = "afspm.components.component.AfspmComponent"
subscriber = "sub"
message_received_method = "analysis.analyze"
"""
    experiment = published(write, MEDIATOR, PICTURE, SCANNING, analysis)
    found = {error.place.line: error for error in errors(experiment)}
    assert len(found) == 2, found
    scanning = found[line_of(experiment, 'class = "afspm.components.scan.handler')]
    assert "[experiment] ScanningComponent calls code" in scanning.what
    assert "ScanSeries" in scanning.hint
    assert "afspm.Component" in found[line_of(experiment, 'class = "afspm.components.component.')].hint


def test_missing_published_module_is_not_suggested_for_pip(write: Write, tmp_path: Path) -> None:
    (tmp_path / "roi.py").write_text("from afspm.utils import csv\n", encoding="utf-8")
    text = '[own]\ncomponent = true\nclass = "roi.Experimenter"\nsubscriber = "sub"\n'
    (error,) = errors(published(write, MEDIATOR, PICTURE, text))
    assert "written for the published implementation" in error.hint
    assert "pip install" not in error.hint
    assert "from-the-published-implementation" in error.hint


def test_variable_that_only_an_overlay_defines_is_a_finding(write: Write) -> None:
    text = WIRING.replace("request_timeout_ms = 5000\n", "")
    (error,) = errors(write(text + MEDIATOR + PICTURE + SERIES, frame=""))
    assert "request_timeout_ms = 'request_timeout_ms' is not a number" in error.what
    assert "second file" in error.hint
    assert errors(write(text + MEDIATOR + PICTURE + SERIES, "request_timeout_ms = 1000\n", frame="")) == []


def test_the_short_form_is_the_same_experiment(write: Write, tmp_path: Path) -> None:
    long = published(write, DRIFT, PICTURE, SERIES.replace('"sub"', '"full_sub"'), SHOWN, METADATA)
    text = short(long.resolved)
    assert "tcp://" not in text
    assert "afspm." not in text
    (tmp_path / "short.toml").write_text(text, encoding="utf-8")
    brief = load(tmp_path / "short.toml")
    assert errors(brief) == []
    assert _known(brief) == _known(long)
    assert brief.resolved.caching.history == long.resolved.caching.history
    for mine, theirs in zip(brief.resolved.caching.rules, long.resolved.caching.rules, strict=True):
        assert vars(mine) == pytest.approx(vars(theirs))
    for part in brief.parts.components:
        (same,) = [other for other in long.parts.components if other.name == part.name]
        assert brief.resolved.processes[part.name].envelopes == long.resolved.processes[same.name].envelopes
    assert brief.resolved.sections.control.request_timeout_s == 5.0


def test_addresses_of_other_computers_stay_in_the_short_form(write: Write, tmp_path: Path) -> None:
    wiring = WIRING.replace('psc_url = "tcp://127.0.0.1', 'psc_url = "tcp://192.168.1.20').replace(
        'router_url = "tcp://127.0.0.1', 'router_url = "tcp://192.168.1.20'
    )
    text = short(write(wiring + MEDIATOR + PICTURE + SERIES + "[security]\ninsecure = true\n", frame="").resolved)
    (tmp_path / "short.toml").write_text(text, encoding="utf-8")
    links = load(tmp_path / "short.toml").resolved.net.links["experiment"]
    assert (links.subscribe, links.control) == (("tcp://192.168.1.20:9001",), "tcp://192.168.1.20:6667")


def test_a_series_that_a_published_function_took_is_proposed(write: Write, tmp_path: Path) -> None:
    text = short(published(write, MEDIATOR, PICTURE, SCANNING).resolved)
    assert "see that this is so" in text
    (tmp_path / "short.toml").write_text(text, encoding="utf-8")
    proposed = load(tmp_path / "short.toml")
    assert errors(proposed) == []
    series = proposed.resolved.processes["experiment"].settings
    assert series["size"] == pytest.approx([200e-9, 200e-9])
    assert series["center"] == pytest.approx([100e-9, 100e-9])
    assert (series["pixels"], series["every"]) == ([256, 128], 5.0)


def test_every_line_is_explained(write: Write) -> None:
    experiment = published(write, DRIFT, PICTURE, SCANNING, SHOWN, METADATA)
    told = {line: became for _, line, became in explained(experiment.resolved)}
    assert told["[mediator] update_weight"] == (
        'drift.tracker.class = "paper", drift.tracker.w_update = 0.8, drift.tracker.queue = 7'
    )
    assert told["[translator] class"].startswith('class = "Simulator"; a picture of yours is shown by ImageMicroscope')
    assert told["pub_url"].startswith("filled in")
    assert told["xop_url"] == '"tcp://127.0.0.1:5555" stands where it is named'
    assert "dashboard, [ui]" in told["[visualizer] class"]
    assert "ScanList" in told["[experiment] class"]
    assert told["full_id"] == 'the envelope "Scan2d_200.0_Height"'
    assert all(told.values())
    written = {*experiment.parts.variables, *experiment.parts.intermediaries}
    assert written <= told.keys()


def test_the_time_of_a_scan_is_a_speed(write: Write) -> None:
    experiment = published(write, MEDIATOR, PICTURE, SERIES)
    assert experiment.resolved.processes["translator"].settings["initial"] == {"scan-speed": "25.6 um/s"}
    assert "25.6 um/s" in short(experiment.resolved)
    told = {line: became for _, line, became in explained(experiment.resolved)}
    assert told["[translator] scan_time_s"] == 'initial.scan-speed = "25.6 um/s"'


def test_rescanner_without_a_drift_scheduler_is_dropped(write: Write, tmp_path: Path) -> None:
    rescanner = DRIFT[DRIFT.index("[rescanner]") :]
    experiment = published(write, MEDIATOR, PICTURE, SERIES, rescanner)
    assert errors(experiment) == []
    assert "rescanner" not in experiment.component_names
    assert "escanner" not in short(experiment.resolved)
    told = {line: became for _, line, became in explained(experiment.resolved)}
    assert told["[rescanner] class"].startswith("left out: there is no drift scheduler")


def test_the_command_prints_the_short_form_alone_to_stdout(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    experiment = published(write, DRIFT, PICTURE, SERIES)
    monkeypatch.chdir(experiment.folder)
    done = CliRunner().invoke(app, ["check", "--explain", "night.toml"])
    assert done.exit_code == 0, done.stderr
    assert done.stdout == short(load("night.toml").resolved)
    line = line_of(experiment, "update_weight")
    assert f"night.toml:{line}: [mediator] update_weight: drift.tracker.class" in done.stderr


def _known(experiment: Experiment) -> dict[str, tuple[str, dict[str, Any]]]:
    return {name: (process.class_path, process.settings) for name, process in experiment.resolved.processes.items()}
