"""The things that messages are about: scans, spectra, regions, states, requests. Frozen, in SI, numpy alone."""

from __future__ import annotations

from afspm.model.events import (
    ControlEvent,
    JournalEntries,
    JournalEntry,
    LogLine,
    LogLines,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    Progress,
    RelayedMessage,
    Role,
    component_of,
    is_process_name,
)
from afspm.model.geometry import Frame, Region, RegionChange
from afspm.model.packet import LoggedPacket, Packet, PacketHeader
from afspm.model.problems import Problem, ProblemNames
from afspm.model.requests import (
    CLOCK_REQUEST,
    HAS_ENDED,
    OTHER_RUN_RESPONSE,
    RELAY_REQUEST,
    RESTART_REQUEST,
    ControlRequest,
    ControlResponse,
    Parameter,
    Request,
    RescanKind,
    Response,
    ResponseDetail,
    request_name,
)
from afspm.model.scan import Scan, ScanParameters, ScanSet, ShapeChange
from afspm.model.scan_lines import ScanLines
from afspm.model.spectrum import Spectrum
from afspm.model.state import (
    ControlMode,
    ControlState,
    Feedback,
    PositionChange,
    ProbePosition,
    ScopeState,
    ScopeStatus,
)

__all__ = [
    "CLOCK_REQUEST",
    "HAS_ENDED",
    "OTHER_RUN_RESPONSE",
    "RELAY_REQUEST",
    "RESTART_REQUEST",
    "ControlEvent",
    "ControlMode",
    "ControlRequest",
    "ControlResponse",
    "ControlState",
    "Feedback",
    "Frame",
    "JournalEntries",
    "JournalEntry",
    "LogLine",
    "LogLines",
    "LoggedPacket",
    "Packet",
    "PacketHeader",
    "Parameter",
    "PositionChange",
    "ProbePosition",
    "Problem",
    "ProblemNames",
    "ProcessCondition",
    "ProcessState",
    "ProcessStates",
    "Progress",
    "Region",
    "RegionChange",
    "RelayedMessage",
    "Request",
    "RescanKind",
    "Response",
    "ResponseDetail",
    "Role",
    "Scan",
    "ScanLines",
    "ScanParameters",
    "ScanSet",
    "ScopeState",
    "ScopeStatus",
    "ShapeChange",
    "Spectrum",
    "component_of",
    "is_process_name",
    "request_name",
]
