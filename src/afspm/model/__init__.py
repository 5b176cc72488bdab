"""Scans, spectra, regions, states and requests: values in SI units that need only numpy.

**Theory of operation.** No code changes a value of the model after its construction. Arrays are [y, x] with ascending
coordinates; lengths are in m, angles in rad and counter-clockwise, times in ns since the Unix epoch. A name with a
unit (`center_m`, `time_ns`) is in that unit; a value whose unit varies carries it (`Scan.unit`).

    comes in      decoded messages (`wire`), files of controllers (`storage.formats`), values of scripts
    state         none
    goes out      the same values to handlers, drivers, the record
    always holds  regions, scans, spectra, sweeps, notes and grants are valid: their constructors raise InvalidValue

The model also holds the small pure decisions that scheduler and translator share: which connection may speak for
a name (`sessions`), which scheduler a translator obeys (`fencing`), and that a request is not executed twice
(`idempotency_cache`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.model import parameter_names as names
    from afspm.model.channels import (
        HEIGHT_RETRACE,
        TOPOGRAPHY,
        ChannelName,
        ChannelRoles,
        both_ways,
        of_role,
    )
    from afspm.model.events import (
        LONGEST_NOTE,
        PERSON,
        ControlEvent,
        JournalEntries,
        JournalEntry,
        LogLine,
        Note,
        ProcessCondition,
        ProcessState,
        ProcessStates,
        Progress,
        RelayedMessage,
        Role,
        component_of,
    )
    from afspm.model.geometry import XY, Frame, Region, RegionChange
    from afspm.model.grants import Approval, Approvals, Grant, GrantedCount, GrantedRange, GrantedStep, Proposal
    from afspm.model.instruments import (
        InstrumentOrder,
        InstrumentReading,
        InstrumentReadings,
        OrderOutcome,
        is_of_instrument,
    )
    from afspm.model.packet import LoggedPacket, Packet, PacketHeader
    from afspm.model.panel import ActByHand, MeasurementConditions, PanelAct, TipStatus
    from afspm.model.problems import STOPPED_BY_AGENT, Problem, ProblemNames
    from afspm.model.registration_outcome import RegistrationOutcome, registration_summary
    from afspm.model.requests import (
        CLOCK_REQUEST,
        GRANT_REQUEST,
        HAS_ENDED,
        LEASE_AT_ONCE_S,
        LEASE_REQUEST,
        RELAY_REQUEST,
        RESTART_REQUEST,
        WAIT_FOR_CONTROL,
        ControlRequest,
        ControlResponse,
        Parameter,
        Request,
        RescanKind,
        Response,
        ResponseDetail,
        request_name,
    )
    from afspm.model.scan import Scan, ScanLines, ScanParameters, ScanSet
    from afspm.model.scan_history import ScanHistory
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
    from afspm.model.variables import HEIGHT, RETRACE

__all__ = [
    "CLOCK_REQUEST",
    "GRANT_REQUEST",
    "HAS_ENDED",
    "HEIGHT",
    "HEIGHT_RETRACE",
    "LEASE_AT_ONCE_S",
    "LEASE_REQUEST",
    "LONGEST_NOTE",
    "PERSON",
    "RELAY_REQUEST",
    "RESTART_REQUEST",
    "RETRACE",
    "STOPPED_BY_AGENT",
    "TOPOGRAPHY",
    "WAIT_FOR_CONTROL",
    "XY",
    "ActByHand",
    "Approval",
    "Approvals",
    "ChannelName",
    "ChannelRoles",
    "ControlEvent",
    "ControlMode",
    "ControlRequest",
    "ControlResponse",
    "ControlState",
    "Feedback",
    "Frame",
    "Grant",
    "GrantedCount",
    "GrantedRange",
    "GrantedStep",
    "InstrumentOrder",
    "InstrumentReading",
    "InstrumentReadings",
    "JournalEntries",
    "JournalEntry",
    "LogLine",
    "LoggedPacket",
    "MeasurementConditions",
    "Note",
    "OrderOutcome",
    "Packet",
    "PacketHeader",
    "PanelAct",
    "Parameter",
    "PositionChange",
    "ProbePosition",
    "Problem",
    "ProblemNames",
    "ProcessCondition",
    "ProcessState",
    "ProcessStates",
    "Progress",
    "Proposal",
    "Region",
    "RegionChange",
    "RegistrationOutcome",
    "RelayedMessage",
    "Request",
    "RescanKind",
    "Response",
    "ResponseDetail",
    "Role",
    "Scan",
    "ScanHistory",
    "ScanLines",
    "ScanParameters",
    "ScanSet",
    "ScopeState",
    "ScopeStatus",
    "Spectrum",
    "TipStatus",
    "both_ways",
    "component_of",
    "is_of_instrument",
    "names",
    "of_role",
    "registration_summary",
    "request_name",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.model.channels": "HEIGHT_RETRACE TOPOGRAPHY ChannelName ChannelRoles both_ways of_role",
            "afspm.model.events": (
                "LONGEST_NOTE PERSON ControlEvent JournalEntries JournalEntry LogLine Note "
                "ProcessCondition ProcessState ProcessStates Progress RelayedMessage Role component_of"
            ),
            "afspm.model.geometry": "XY Frame Region RegionChange",
            "afspm.model.grants": "Approval Approvals Grant GrantedCount GrantedRange GrantedStep Proposal",
            "afspm.model.instruments": (
                "InstrumentOrder InstrumentReading InstrumentReadings OrderOutcome is_of_instrument"
            ),
            "afspm.model.packet": "LoggedPacket Packet PacketHeader",
            "afspm.model.panel": "ActByHand MeasurementConditions PanelAct TipStatus",
            "afspm.model.problems": "STOPPED_BY_AGENT Problem ProblemNames",
            "afspm.model.registration_outcome": "RegistrationOutcome registration_summary",
            "afspm.model.requests": (
                "CLOCK_REQUEST GRANT_REQUEST HAS_ENDED LEASE_AT_ONCE_S LEASE_REQUEST RELAY_REQUEST "
                "RESTART_REQUEST WAIT_FOR_CONTROL ControlRequest ControlResponse Parameter Request RescanKind "
                "Response ResponseDetail request_name"
            ),
            "afspm.model.scan": "Scan ScanLines ScanParameters ScanSet",
            "afspm.model.scan_history": "ScanHistory",
            "afspm.model.spectrum": "Spectrum",
            "afspm.model.state": (
                "ControlMode ControlState Feedback PositionChange ProbePosition ScopeState ScopeStatus"
            ),
            "afspm.model.variables": "HEIGHT RETRACE",
        },
        names="afspm.model.parameter_names",
    )
