"""The door for authors of drivers: what a driver of a maker's controller is made of.

A driver is a class derived from `Driver` with a table of parameters. It reads and sets their values, starts and stops
measurements, and returns their results; `docs/how-to/write-a-driver.md` goes through it in order. Nothing is defined
here: each name is imported from its module when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.model.caption import SENSITIVITY, SPRING_CONSTANT, SettingInForce, stated_settings
    from afspm.model.variables import VariableRoles
    from afspm.storage.formats import hdf5_reading
    from afspm.storage.formats.content import FileContent, OtherFormat, local_ns, name_and_unit, text_of
    from afspm.translator.activity import Activity, TipWay
    from afspm.translator.driver import Driver
    from afspm.translator.driver_base import ControllerLost, action, connected
    from afspm.translator.folder_files import FolderFiles
    from afspm.translator.judge import Stated
    from afspm.translator.long_call import ANSWERS_S, LongCall
    from afspm.translator.parameters import FEEDBACK_ON, Value
    from afspm.translator.result_files import (
        SCAN,
        Content,
        Entry,
        FilePrecision,
        ResultFiles,
        lines_missing,
        modified_ns,
        read_result,
    )
    from afspm.translator.scripted_driver import ScriptedDriver
    from afspm.translator.setting_groups import (
        FRAME,
        POSITION,
        KeptSettings,
        SettingsGroup,
        as_list,
        as_region,
        check_speed,
        frame,
        frame_values,
    )
    from afspm.translator.shadow import ShadowDriver, refusal, require_question
    from afspm.translator.state import Kept
    from afspm.translator.tcp import Receiver, TcpConnection, host_and_port
    from afspm.translator.zmq_connection import ZmqConnection

if TYPE_CHECKING:  # for the tests of a shadow
    from afspm.translator.contact import contact

if TYPE_CHECKING:  # one maker's controller has it today, and another's may
    from afspm.storage.formats import igor, netcdf
    from afspm.storage.formats.content import clock_ns
    from afspm.translator.driver_base import LOST, CoarseMove, ControllerSilent, Introduction
    from afspm.translator.own_files import FileFacts, encode_scan, encode_spectrum
    from afspm.translator.parameters import ParameterSpec, refuse_value
    from afspm.translator.result_files import missing_text, newest
    from afspm.translator.setting_groups import CENTER
    from afspm.translator.trace import TCP, TRACE

__all__ = [
    "ANSWERS_S",
    "CENTER",
    "FEEDBACK_ON",
    "FRAME",
    "LOST",
    "POSITION",
    "SCAN",
    "SENSITIVITY",
    "SPRING_CONSTANT",
    "TCP",
    "TRACE",
    "Activity",
    "CoarseMove",
    "Content",
    "ControllerLost",
    "ControllerSilent",
    "Driver",
    "Entry",
    "FileContent",
    "FileFacts",
    "FilePrecision",
    "FolderFiles",
    "Introduction",
    "Kept",
    "KeptSettings",
    "LongCall",
    "OtherFormat",
    "ParameterSpec",
    "Receiver",
    "ResultFiles",
    "ScriptedDriver",
    "SettingInForce",
    "SettingsGroup",
    "ShadowDriver",
    "Stated",
    "TcpConnection",
    "TipWay",
    "Value",
    "VariableRoles",
    "ZmqConnection",
    "action",
    "as_list",
    "as_region",
    "check_speed",
    "clock_ns",
    "connected",
    "contact",
    "encode_scan",
    "encode_spectrum",
    "frame",
    "frame_values",
    "hdf5_reading",
    "host_and_port",
    "igor",
    "lines_missing",
    "local_ns",
    "missing_text",
    "modified_ns",
    "name_and_unit",
    "netcdf",
    "newest",
    "read_result",
    "refusal",
    "refuse_value",
    "require_question",
    "stated_settings",
    "text_of",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.model.caption": "SENSITIVITY SPRING_CONSTANT SettingInForce stated_settings",
            "afspm.model.variables": "VariableRoles",
            "afspm.storage.formats": "hdf5_reading igor netcdf",
            "afspm.storage.formats.content": "FileContent OtherFormat local_ns name_and_unit text_of clock_ns",
            "afspm.translator.activity": "Activity TipWay",
            "afspm.translator.contact": "contact",
            "afspm.translator.driver": "Driver",
            "afspm.translator.driver_base": "ControllerLost action connected "
            "LOST CoarseMove ControllerSilent Introduction",
            "afspm.translator.folder_files": "FolderFiles",
            "afspm.translator.judge": "Stated",
            "afspm.translator.long_call": "ANSWERS_S LongCall",
            "afspm.translator.own_files": "FileFacts encode_scan encode_spectrum",
            "afspm.translator.parameters": "FEEDBACK_ON Value ParameterSpec refuse_value",
            "afspm.translator.result_files": (
                "SCAN Content Entry FilePrecision ResultFiles lines_missing modified_ns read_result missing_text newest"
            ),
            "afspm.translator.scripted_driver": "ScriptedDriver",
            "afspm.translator.setting_groups": (
                "FRAME POSITION KeptSettings SettingsGroup as_list as_region check_speed frame frame_values CENTER"
            ),
            "afspm.translator.shadow": "ShadowDriver refusal require_question",
            "afspm.translator.state": "Kept",
            "afspm.translator.tcp": "Receiver TcpConnection host_and_port",
            "afspm.translator.trace": "TCP TRACE",
            "afspm.translator.zmq_connection": "ZmqConnection",
        },
    )
