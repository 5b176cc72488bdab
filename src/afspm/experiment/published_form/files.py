"""Classes and settings in files of the published implementation, with their afspm counterparts, if any."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from afspm.basics import AfspmError, InvalidValue, si
from afspm.experiment.document import Document
from afspm.experiment.parts import ExperimentParts
from afspm.experiment.toml_lines import Settings, Table
from afspm.experiment.toml_writer import value as toml
from afspm.experiment.wiring_classes import WIRE_KEYS
from afspm.model import PacketHeader
from afspm.scheduler.publishing.envelopes import default_envelope

COMPONENTS: Final = "afspm.components."
"""Package of the published components, whose modules moved between versions."""
GUIDE: Final = "see docs/how-to/from-the-published-implementation.md"
WIRES: Final = "afspm.io."
"""Package of the published intermediary classes, whose modules moved between versions."""
_WIRES: Final = {
    "Publisher": "Publisher",
    "PubSubCache": "Cache",
    "Subscriber": "Subscriber",
    "ComboSubscriber": "Subscriber",
    "ControlServer": "Server",
    "ControlRouter": "Router",
    "ControlClient": "Client",
    "AdminControlClient": "Client",
}
CACHE_LOGIC: Final = ("PBCScanLogic", "ProtoBasedCacheLogic", "CacheLogic")
ENVELOPES: Final = ("create_roi_scan_envelope", "create_spec_envelope")
FUNCTIONS: Final = (*CACHE_LOGIC, *ENVELOPES, "create_roi_proto_hist_list")
_MEANINGLESS: Final = (
    "get_envelope_for_proto", "pub_get_envelope_for_proto", "sub_extract_proto", "extract_proto_kwargs",
    "update_cache", "update_cache_kwargs", "uuid",
)  # fmt: skip
"""Settings for decoding and naming packets; left out, since afspm has one wire format, and names packets by [cache]."""
CHANNEL: Final = "Height"
"""The simulated microscope's channel, in place of the channel of a published picture."""

Becomes = Callable[[object, Table], Settings]


@dataclass(frozen=True)
class PublishedSetting:
    """A setting of a published class.

    Attributes:
        becomes: returns the afspm settings (dotted names for tables) for a value and its table.
        why: for a setting without counterpart, how afspm does the same.
    """

    becomes: Becomes
    why: str = ""


@dataclass(frozen=True)
class PublishedClass:
    """A published class with a counterpart in afspm.

    Attributes:
        ours: name of afspm's class.
        settings: settings that change, by their published names; all others are kept.
        why: a remark on the counterpart, for the explanation of the file.
        defaults: settings that the file may override, where afspm's own defaults do not fit.
    """

    ours: str
    settings: Mapping[str, PublishedSetting] = field(default_factory=dict)
    why: str = ""
    defaults: Mapping[str, object] = field(default_factory=dict)


def wire_of(table: object) -> str:
    """Return the name of the published intermediary or function in a table, without its module; empty if none."""
    name = table.get("class") if isinstance(table, Mapping) else None
    if not isinstance(name, str) or not name.startswith(WIRES):
        return ""
    last_name = name.rpartition(".")[2]
    return last_name if last_name in _WIRES or last_name in FUNCTIONS else ""


def converted(value: object, channels: Mapping[str, str]) -> Any:
    """Convert intermediaries within a value, and replace calls of the envelope functions by the resulting envelope.

    Args:
        channels: new names of the file's channels, by old name.
    """
    if isinstance(value, list):
        return [converted(item, channels) for item in value]
    if not isinstance(value, dict):
        return value
    kind = wire_of(value)
    if kind in ENVELOPES:
        return envelope(with_channels(value, channels))
    inside = {key: converted(item, channels) for key, item in with_channels(value, channels).items()}
    if kind == "ComboSubscriber":
        return _combined(inside)
    if kind in _WIRES:
        inside["class"] = _WIRES[kind]
        return {key: item for key, item in inside.items() if key not in _MEANINGLESS}
    return inside


def _combined(table: Table) -> Settings:
    # several subscribers become one
    urls: list[object] = []
    topics: list[object] = []
    for one in table.get("subs", ()):
        if isinstance(one, Mapping):
            given, wanted = one.get("sub_url", ()), one.get("topics_to_sub", ())
            urls += [given] if isinstance(given, str) else given
            topics += [wanted] if isinstance(wanted, str) else wanted
    return {"class": "Subscriber", "sub_url": urls} | ({"topics_to_sub": topics} if topics else {})


def with_channels(table: Table, channels: Mapping[str, str]) -> Settings:
    """Return the table of a published function with its channels renamed; other tables are returned unchanged."""
    renamed = dict(table)
    match wire_of(renamed):
        case "create_roi_scan_envelope" if "channel" in renamed:
            renamed["channel"] = channels.get(renamed["channel"], renamed["channel"])
        case "create_roi_proto_hist_list" if isinstance(given := renamed.get("channels_list"), list):
            renamed["channels_list"] = [channels.get(channel, channel) for channel in given]
    return renamed


def cache_section(logic: object) -> Settings:
    """Return the section [cache] for a published cache logic; empty for any other table or value.

    Sizes without a unit are in nm, as in envelopes.
    """
    if wire_of(logic) not in CACHE_LOGIC or not isinstance(logic, Mapping):
        return {}
    count = logic.get("default_scan_history")
    section: Settings = {"history": {"Scan2d": count}} if isinstance(count, int) and count > 0 else {}
    histories = logic.get("proto_with_history_list")
    rules: list[Settings] = []
    if isinstance(histories, Mapping) and wire_of(histories) == "create_roi_proto_hist_list":
        channels = histories.get("channels_list") or []
        for number, entry in enumerate(histories.get("sizes_with_hist_list", ())):
            match entry:
                case [[width, *_], int(most)] if most > 0:
                    nm = length_m(width) * 1e9
                    rule = {"above": f"{nm * 0.999:.9g} nm", "up_to": f"{nm * 1.001:.9g} nm", "history": most}
                    channel = {"channel": channels[number]} if number < len(channels) else {}
                    rules.append({"message": "Scan2d", **channel, **rule})
    return section | ({"rules": rules} if rules else {})


def envelope(table: Table) -> object:
    """Return the envelope that create_spec_envelope or create_roi_scan_envelope returns for a table of arguments.

    A size without a unit is in nm, as in the envelopes themselves. A table with unusable arguments is returned
    unchanged.
    """
    if wire_of(table) == "create_spec_envelope":
        return default_envelope(PacketHeader("Spec1d", kind=str(table.get("type", ""))))
    try:
        width_m, height_m = (length_m(side) for side in table["size"])
    except (AfspmError, KeyError, TypeError, ValueError):
        return dict(table)
    return default_envelope(PacketHeader("Scan2d", str(table.get("channel", "")), (width_m, height_m)))


def length_m(value: str | float) -> float:
    """Return a length in the cache settings in m: a text with its unit, or a number in nm."""
    return si(value, "m") if isinstance(value, str) else float(value) * 1e-9


def renamed_channels(components: Mapping[str, Table]) -> dict[str, str]:
    """Return new channel names by old names, for the image translators among a file's components.

    The new name is always `CHANNEL`.
    """
    pictures = (table for table in components.values() if last(table) in _PICTURES)
    return {str(table["channel_id"]): CHANNEL for table in pictures if "channel_id" in table}


def class_of(table: Table) -> PublishedClass | None:
    """Return the afspm counterpart of a component's class; None for an unknown class."""
    name, path = last(table), str(table.get("class", ""))
    if not path.startswith(COMPONENTS) and name != "DriftImageTranslator":  # beside the file, in its samples
        return None
    if name in _PICTURES:
        if "img_path" in table:
            return PublishedClass("ImageMicroscope", _EVERY | _PICTURE)
        # the steps of the default surface look alike along their edges: drift could be measured across them only
        defaults = {"surface": "particles"} if name == "DriftImageTranslator" else {}
        why = "a picture of yours is shown by ImageMicroscope with `file`"
        return PublishedClass("Simulator", _EVERY | _PICTURE, why, defaults)
    return CLASSES.get(name)


def without_counterpart(path: str) -> str:
    """Return advice for a published class without counterpart; empty for all other classes."""
    return INSTEAD.get(path.rpartition(".")[2], "") if path.startswith(COMPONENTS) else ""


def put(settings: Settings, name: str, value: object) -> None:
    """Set a setting, by a dotted name if it is within tables: put({}, "drift.channel", "Height").

    Raises:
        InvalidValue: the setting already has another value.
    """
    *tables, key = name.split(".")
    for table in tables:
        settings = settings.setdefault(table, {})
        if not isinstance(settings, dict):
            raise InvalidValue(f"it is {name} here, and {table} is set, too", hint="say one of them")
    if settings.setdefault(key, value) != value:
        raise InvalidValue(f"it is {name} here, which is {settings[key]!r} already", hint="say one of them")


def last(table: Table) -> str:
    """Return the class name in a table, without its module."""
    return str(table.get("class", "")).rpartition(".")[2]


def _named(ours: str) -> PublishedSetting:
    return PublishedSetting(lambda value, table: {ours: value})


def _gone(why: str, *names: str) -> dict[str, PublishedSetting]:
    return dict.fromkeys(names, PublishedSetting(lambda value, table: {}, why))


def _paper(ours: str) -> PublishedSetting:
    # the queue of the paper's tracker holds the scans that the published scheduler caches

    def becomes(value: object, table: Table) -> Settings:
        settings = {"drift.tracker.class": "paper", f"drift.tracker.{ours}": value}
        count = _within(table, "pubsubcache", "update_cache_kwargs", "cache_logic", "default_scan_history")
        return settings if count is None else {**settings, "drift.tracker.queue": count}

    return PublishedSetting(becomes)


def _within(value: object, *keys: str) -> object:
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def _estimator(value: Any, table: Table) -> Settings:
    # the published drift model names descriptor and transform by its enumerations
    given = {"descriptor_type": "BRIEF", "transform_type": "TRANSLATION", "fitting": "RANSAC"}
    given |= {key: item for key, item in dict(value).items() if key != "class"}
    known = {key: str(given.pop(key)).rpartition(".")[2].lower() for key in ("descriptor_type", "transform_type")}
    if str(given.pop("fitting")).rpartition(".")[2] != "RANSAC" or given:
        what = ", ".join(given) or "another fitting than RANSAC"
        raise InvalidValue(f"{what} is not taken over", hint="drift.estimator has settings of its own")
    return {
        "drift.estimator.class": known["descriptor_type"],
        "drift.estimator.transform": known["transform_type"],
        "drift.tracker.class": "paper",
        "drift.tracker.transform": known["transform_type"],
    }


def _oldest(value: object, table: Table) -> Settings:
    if value is not True:
        raise InvalidValue("the paper's tracker compares with the oldest scan that fits", hint="leave the line out")
    return {}


def _client(address: Callable[[Table], str]) -> Becomes:
    # the published translator gets a client object: its table has the controller's address and timeout

    def becomes(value: object, table: Table) -> Settings:
        if not isinstance(value, Mapping):
            raise InvalidValue(
                f"{value!r} is not a table of a client", hint='address = "…" says where the controller is'
            )
        found = {"address": address(value)}
        if "timeout_s" in value:
            found["reply_timeout_s"] = f"{value['timeout_s']} s"
        elif "timeout_ms" in value:
            found["reply_timeout_s"] = f"{value['timeout_ms']} ms"
        return found

    return becomes


def _refused(hint: str) -> PublishedSetting:
    def becomes(value: object, table: Table) -> Settings:
        raise InvalidValue("this is not taken over", hint=hint)

    return PublishedSetting(becomes)


def _width(value: Any, table: Table) -> Settings:
    return {"width": f"{value[0]} {table.get('physical_units', 'nm')}"} if "img_path" in table else {}


def _speed(value: Any, table: Table) -> Settings:
    # the published setting is the time of a scan over the width of the picture, each line forth and back
    size, unit = table.get("physical_size"), str(table.get("physical_units", "nm"))
    width_m = si(f"{size[0]} {unit}", "m") if isinstance(size, list) else _WIDTH_M
    return {"initial.scan-speed": f"{2 * _LINES * width_m / float(value) * 1e6:.6g} um/s"}


def _velocity(value: Any, table: Table) -> Settings:
    unit = f"{table.get('spatial_units', 'nm')}/{table.get('temporal_units', 's')}"
    x, y = (si(f"{part} {unit}", "m/s") for part in value)
    return {"drift.velocity_m_per_s": [x, y, 0.0]}


_LINES, _WIDTH_M = 128, 1e-6
"""Lines and width of a scan with default settings."""
_PICTURES: Final = ("ImageTranslator", "DriftImageTranslator")
_EVERY: Final[dict[str, PublishedSetting]] = {
    **_gone("a process waits for its next message and never sleeps", "loop_sleep_s", "poll_timeout_ms"),
    **_gone("[restart] beat_period and missed_beats", "beat_period_s", "hb_period_s"),
    **_gone("[restart] start is the longest time for it", "spawn_delay_s"),
    **_gone("a component is called as its table", "override_client_uuid", "uuid"),
}
_PICTURE: Final[dict[str, PublishedSetting]] = {
    "img_path": _named("file"),
    "physical_size": PublishedSetting(_width, "the simulated surface has no border"),
    "drift_rate": PublishedSetting(_velocity),
    **_gone("the middle of the sample is the origin", "physical_origin"),
    **_gone("each length has its unit", "physical_units", "data_units", "spatial_units", "temporal_units"),
    "scan_time_s": PublishedSetting(_speed),
    **_gone("the tip moves as fast as it scans", "move_time_s"),
    **_gone(f"the channel is {CHANNEL}", "channel_id"),
}
_ASYLUM: Final[dict[str, PublishedSetting]] = {
    "xop_client": PublishedSetting(_client(lambda client: str(client.get("url", ""))))
}
_NANONIS: Final[dict[str, PublishedSetting]] = {
    "client": PublishedSetting(
        _client(lambda client: f"{client.get('host', '127.0.0.1')}:{client.get('port', 6501)}"),
    ),
    **_gone("a spectroscopy is started with its kind", "mode"),
}
_GXSM: Final = _gone(
    "channels are read in the physical units that GXSM's files give",
    "read_channels_config_path", "read_use_physical_units", "read_allow_convert_from_metadata",
    "read_simplify_metadata",
)  # fmt: skip
_HANDLERS: Final[dict[str, PublishedSetting]] = {
    "param_handler": _refused("write your parameters as the table `parameters`"),
    "action_handler": _refused("write your actions as the table `actions`"),
    **_gone("a parameter's own step says when it is reached", "float_tolerance"),
}
_DRIFT: Final[dict[str, PublishedSetting]] = {
    "channel_id": _named("drift.channel"),
    "update_weight": _paper("w_update"),
    "min_intersection_ratio": _paper("f_min"),
    "min_spatial_res_ratio": _paper("sr_norm_min"),
    "rescan_intersection_ratio": PublishedSetting(
        lambda value, table: {"drift.rescan.rule": "paper", "drift.rescan.f_rescan": value}
    ),
    "drift_model": PublishedSetting(_estimator),
    "grab_oldest_match": PublishedSetting(_oldest, "the oldest scan that fits is taken"),
    **_gone("a pair counts where chance would hardly match it as well", "max_fitting_score"),
    **_gone("the component DriftTable writes drift_correction.csv into the folder of the run", "csv_attribs"),
    **_gone("the dashboard shows drift, and the component DriftPictures draws it", "display_fit"),
}
# its settings until 27 May 2025, before it had those of its successor
_EARLY_DRIFT: Final[dict[str, PublishedSetting]] = {
    "intersection_ratio": _refused("min_intersection_ratio is the least overlap of a pair of scans"),
    "correction_history_length": _refused("drift.tracker has settings of its own"),
}
_RESCANNER: Final = {
    **_gone("a rescan is asked for as soon as the microscope is free", "rerun_wait_s"),
    **_gone("it listens to what the scheduler publishes", "scan_params_id", "control_state_id", "scope_state_id"),
}
_SHOWN: Final = _gone(
    "the dashboard shows every channel and region; who looks chooses palette and levelling",
    "list_keys", "channels_list", "cache_meaning_list", "scan_phys_origin_list", "scan_phys_size_list", "scan_id",
    "visualization_style_list", "visualization_colormap_list", "visualize_undeclared_scans",
    "message_received_method", "per_loop_method", "methods_kwargs",
)  # fmt: skip

CLASSES: Final[dict[str, PublishedClass]] = {
    "MicroscopeMediator": PublishedClass("Scheduler", _EVERY),
    "MicroscopeScheduler": PublishedClass("Scheduler", _EVERY),
    "DriftCompensatedMediator": PublishedClass("DriftCompensatedScheduler", _EVERY | _DRIFT),
    "DriftCompensatedScheduler": PublishedClass("DriftCompensatedScheduler", _EVERY | _DRIFT),
    "CSCorrectedScheduler": PublishedClass("DriftCompensatedScheduler", _EVERY | _DRIFT | _EARLY_DRIFT),
    "DriftRescanner": PublishedClass("Rescanner", _EVERY | _RESCANNER),
    "ScanMetadataWriter": PublishedClass(
        "Metadata", _EVERY | _gone("metadata.csv is in the run's folder", "csv_attribs")
    ),
    "FeedbackAnalyzer": PublishedClass("FeedbackAnalysis", _EVERY),
    "FeedbackCorrector": PublishedClass("FeedbackTuner", _EVERY),
    "AfspmControlUI": PublishedClass("Dashboard", _EVERY),
    "Visualizer": PublishedClass("Dashboard", _EVERY | _SHOWN),
    "AsylumTranslator": PublishedClass("Asylum", _EVERY | _HANDLERS | _ASYLUM),
    "GxsmTranslator": PublishedClass("Gxsm", _EVERY | _HANDLERS | _GXSM),
    "NanonisTranslator": PublishedClass("Nanonis", _EVERY | _HANDLERS | _NANONIS),
}
"""afspm's counterparts by the published name of the class, without its module, which varied between versions."""

_OWN = "derive a class of your own from afspm.Component, with on_scan, on_state … or a `run`"
_TRANSLATOR = 'derive a class of your own from afspm.translator.Driver: "afspm new driver"'
INSTEAD: Final[dict[str, str]] = {
    "ScanningComponent": "ScanSeries takes a region again and again, ScanList takes one after the other, RegionGrid a "
    "map; where its function chooses by what was measured, write the choice as `run` of an afspm.Component",
    **dict.fromkeys(("AfspmComponent", "AfspmComponentBase", "AfspmComponentUI"), _OWN),
    **dict.fromkeys(("MicroscopeTranslator", "ConfigTranslator", "MapTranslator", "SXMTranslator"), _TRANSLATOR),
}
"""Advice for published classes that call code written for the published implementation."""


def convert(tables: dict[str, Settings], parts: ExperimentParts, document: Document) -> dict[str, Settings]:
    """Return a file's components in afspm's form; convert the intermediaries and [cache] of `parts` in place."""
    channels = renamed_channels(tables)
    conversion = _Conversion(channels, parts, document)
    for table in tables.values():
        conversion.add_cache(table)
    for name, table in parts.intermediaries.items():
        conversion.note_intermediary(name, table)
        parts.intermediaries[name] = _kept_inside(table, channels)
    found = {name: conversion.component(name, converted(table, channels), table) for name, table in tables.items()}
    ours = {name: table for name, table in found.items() if table is not None}
    conversion.drop_rescanners(ours)
    return ours


def _kept_inside(table: Table, channels: Mapping[str, str]) -> Settings:
    # a function call keeps its table: its result stands where the call is named
    whole = converted(table, channels)
    return whole if isinstance(whole, dict) else with_channels(table, channels)


def _wires_of(table: Table) -> Settings:
    return {key: table[key] for key in WIRE_KEYS if key in table}


@dataclass(frozen=True)
class _Conversion:
    """Conversion of one file's components, with the result for each line of the file."""

    channels: Mapping[str, str]
    parts: ExperimentParts
    document: Document

    def add_cache(self, table: Table) -> None:
        """Add a scheduler's cache settings to [cache]: histories that [cache] lacks, and rules after its own rules."""
        logic = _within(table, "pubsubcache", "update_cache_kwargs", "cache_logic")
        if isinstance(logic, Mapping) and isinstance(histories := logic.get("proto_with_history_list"), Mapping):
            logic = {**logic, "proto_with_history_list": with_channels(histories, self.channels)}
        if section := cache_section(logic):
            given = self.parts.sections.setdefault("cache", {})
            history = {**section.get("history", {}), **given.get("history", {})}
            rules = [*given.get("rules", []), *section.get("rules", [])]
            given.update({key: value for key, value in (("history", history), ("rules", rules)) if value})

    def note_intermediary(self, name: str, table: Table) -> None:
        """Note the result of converting an intermediary table."""
        kind = wire_of(table)
        if kind in ENVELOPES:
            self.parts.became[(name,)] = f"the envelope {toml(envelope(with_channels(table, self.channels)))}"
        elif kind in FUNCTIONS:
            self.parts.became[(name,)] = "[cache]"

    def component(self, name: str, table: Settings, written: Table) -> Settings | None:
        """Return a component in afspm's form; None if afspm runs no process in its place.

        No process is run for a class without counterpart, which is an error in the document, or for a second dashboard.

        Args:
            written: the component before its intermediaries were converted.
        """
        here, path = (name, "class"), table.get("class")
        if not isinstance(path, str):
            return table
        if instead := without_counterpart(path):
            self.parts.instead[name] = table
            self.parts.became[here] = instead
            what = f"[{name}] {last(table)} calls code that is written for the published implementation"
            self.document.error(what, *here, hint=f"{instead}; {GUIDE}")
            return None
        ours = class_of(table)
        if ours is None:
            return table
        if ours.ours == "Dashboard":
            for other, became in self.parts.became.items():
                if became.startswith('class = "Dashboard"'):
                    self.parts.became[here] = f"the dashboard, [{other[0]}], shows this too"
                    return None
        added = {key: value for key, value in ours.defaults.items() if key not in table}
        became = ", ".join(f"{key} = {toml(value)}" for key, value in {"class": ours.ours, **added}.items())
        self.parts.became[here] = f"{became}{ours.why and '; '}{ours.why}"
        settings = {key: value for key, value in table.items() if key not in ours.settings or key in WIRE_KEYS} | added
        for key in filter(ours.settings.__contains__, table):
            self._put(settings, ours.settings[key], (name, key), {**table, **_wires_of(written)})
        return {**settings, "class": ours.ours}

    def drop_rescanners(self, ours: dict[str, Settings]) -> None:
        """Remove rescanners if the file has no drift scheduler, which requests rescans."""
        if any(table.get("class") == "DriftCompensatedScheduler" for table in ours.values()):
            return
        for name in [name for name in ours if self.parts.became.get((name, "class")) == 'class = "Rescanner"']:
            del ours[name]
            why = "left out: there is no drift scheduler that would say what to scan again"
            self.parts.became[name, "class"] = why

    def _put(self, settings: Settings, setting: PublishedSetting, here: tuple[str, str], table: Table) -> None:
        value = table[here[1]]
        try:
            becomes = setting.becomes(self.channels.get(value, value) if here[1] == "channel_id" else value, table)
            for name, one in becomes.items():
                put(settings, name, one)
        except (AfspmError, TypeError, ValueError) as error:
            what, hint = (error.what, error.hint) if isinstance(error, AfspmError) else (str(error), "")
            self.document.error(f"[{here[0]}] {here[1]} = {value!r}: {what}", *here, hint=hint)
            return
        self.parts.became[here] = ", ".join(f"{name} = {toml(one)}" for name, one in becomes.items()) or setting.why
