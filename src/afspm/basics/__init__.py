"""Base of all other packages: errors, units, clock, formatting, addresses, file locks, launch lines, entry points.

Nothing here depends on microscopes, messages or sockets. A module belongs here if at least two packages need it, and
if it imports no other package of afspm.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.basics.addresses import Listens, is_address
    from afspm.basics.clock import NS_PER_S, Clock, ExperimentClock, NeverLate, iso_utc
    from afspm.basics.errors import (
        AfspmError,
        ConfigError,
        ControlLost,
        ExperimentEnded,
        FileError,
        InvalidValue,
        MeasurementFailed,
        NoResponse,
        NoSuchItem,
        NotClear,
        Refused,
        RequestError,
        TransportError,
        UnitError,
        WireError,
    )
    from afspm.basics.exit_codes import ExitCode
    from afspm.basics.formatting import (
        area_text,
        counted,
        day_and_time,
        duration_text,
        escaped,
        lengths_text,
        position_text,
        quantity,
        scale,
        shortest_single,
        typeset_position,
    )
    from afspm.basics.frozen import replace
    from afspm.basics.interpreter import python_command, python_environment
    from afspm.basics.launch import Launch, Sockets
    from afspm.basics.plain_data import Count, Plain, PlainList, PlainMapping, from_json
    from afspm.basics.progress_line import ProgressLine
    from afspm.basics.requirements import require
    from afspm.basics.shared_time import Publication
    from afspm.basics.toml import parse_toml
    from afspm.basics.units import (
        Angle,
        Current,
        Duration,
        Length,
        PollPeriod,
        PositiveLength,
        Speed,
        Voltage,
        convert,
        parse_quantity,
        same_kind,
        si,
        si_or_text,
    )

if TYPE_CHECKING:  # a page shows times in the zone of who reads it, and one line of figures
    from afspm.basics.clock import utc_time
    from afspm.basics.formatting import (
        time_of_day,
        typeset,
        typeset_area,
        typeset_length,
        zone_offset_s,
        zone_offsets_s,
    )

if TYPE_CHECKING:  # a plug-in of its own extras: imports by name, and a missing package
    from afspm.basics.entry_points import load as load_plugin
    from afspm.basics.entry_points import names as plugin_names
    from afspm.basics.named_imports import import_named, require_trusted
    from afspm.basics.requirements import imports_of_extra

__all__ = [
    "NS_PER_S",
    "AfspmError",
    "Angle",
    "Clock",
    "ConfigError",
    "ControlLost",
    "Count",
    "Current",
    "Duration",
    "ExitCode",
    "ExperimentClock",
    "ExperimentEnded",
    "FileError",
    "InvalidValue",
    "Launch",
    "Length",
    "Listens",
    "MeasurementFailed",
    "NeverLate",
    "NoResponse",
    "NoSuchItem",
    "NotClear",
    "Plain",
    "PlainList",
    "PlainMapping",
    "PollPeriod",
    "PositiveLength",
    "ProgressLine",
    "Publication",
    "Refused",
    "RequestError",
    "Sockets",
    "Speed",
    "TransportError",
    "UnitError",
    "Voltage",
    "WireError",
    "area_text",
    "convert",
    "counted",
    "day_and_time",
    "duration_text",
    "escaped",
    "from_json",
    "import_named",
    "imports_of_extra",
    "is_address",
    "iso_utc",
    "lengths_text",
    "load_plugin",
    "parse_quantity",
    "parse_toml",
    "plugin_names",
    "position_text",
    "python_command",
    "python_environment",
    "quantity",
    "replace",
    "require",
    "require_trusted",
    "same_kind",
    "scale",
    "shortest_single",
    "si",
    "si_or_text",
    "time_of_day",
    "typeset",
    "typeset_area",
    "typeset_length",
    "typeset_position",
    "utc_time",
    "zone_offset_s",
    "zone_offsets_s",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.basics.addresses": "Listens is_address",
            "afspm.basics.clock": "NS_PER_S Clock ExperimentClock NeverLate iso_utc utc_time",
            "afspm.basics.errors": (
                "AfspmError ConfigError ControlLost ExperimentEnded FileError InvalidValue "
                "MeasurementFailed NoResponse NoSuchItem NotClear Refused RequestError TransportError UnitError "
                "WireError"
            ),
            "afspm.basics.exit_codes": "ExitCode",
            "afspm.basics.formatting": (
                "area_text counted day_and_time duration_text escaped lengths_text position_text quantity "
                "scale shortest_single typeset_position time_of_day typeset typeset_area typeset_length "
                "zone_offset_s zone_offsets_s"
            ),
            "afspm.basics.frozen": "replace",
            "afspm.basics.interpreter": "python_command python_environment",
            "afspm.basics.launch": "Launch Sockets",
            "afspm.basics.named_imports": "import_named require_trusted",
            "afspm.basics.plain_data": "Count Plain PlainList PlainMapping from_json",
            "afspm.basics.progress_line": "ProgressLine",
            "afspm.basics.requirements": "require imports_of_extra",
            "afspm.basics.shared_time": "Publication",
            "afspm.basics.toml": "parse_toml",
            "afspm.basics.units": (
                "Angle Current Duration Length PollPeriod PositiveLength Speed Voltage convert "
                "parse_quantity same_kind si si_or_text"
            ),
        },
        load_plugin="afspm.basics.entry_points.load",
        plugin_names="afspm.basics.entry_points.names",
    )
