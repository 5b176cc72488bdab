"""What is spoken about: scans, spectra, regions, states, requests. Frozen, in SI units, with numpy alone."""

from __future__ import annotations

from afspm.model.control import Parameter, Request, Response
from afspm.model.enums import (
    CLOCK_REQUEST,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Problem,
    ScopeState,
)
from afspm.model.geometry import Frame, Region, RegionChange
from afspm.model.lines import ScanLines
from afspm.model.packet import Packet, PacketHeader
from afspm.model.problems import ProblemNames
from afspm.model.scan import Scan, ScanParameters, ScanSet, ShapeChange
from afspm.model.spectrum import Spectrum
from afspm.model.state import ControlState, Feedback, PositionChange, ProbePosition, ScopeStatus

__all__ = [
    "CLOCK_REQUEST",
    "ControlMode",
    "ControlRequest",
    "ControlResponse",
    "ControlState",
    "Feedback",
    "Frame",
    "Packet",
    "PacketHeader",
    "Parameter",
    "PositionChange",
    "ProbePosition",
    "Problem",
    "ProblemNames",
    "Region",
    "RegionChange",
    "Request",
    "Response",
    "Scan",
    "ScanLines",
    "ScanParameters",
    "ScanSet",
    "ScopeState",
    "ScopeStatus",
    "ShapeChange",
    "Spectrum",
]
