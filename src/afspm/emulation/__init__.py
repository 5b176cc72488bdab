"""The door for authors of emulated controllers: a simulated instrument behind a maker's protocol.

An emulator answers the protocol as documented and refuses the rest as the maker does. What it measures comes from a
`SimulatedInstrument`, so that all emulators share sample, tip, drift and faults. Nothing is defined here: each name is
imported from its module when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.simulation.activities import RETRACE, ScanActivity, SpectrumActivity
    from afspm.simulation.emulation.controller_clock import ControllerClock
    from afspm.simulation.emulation.emulator import LOOPBACK, Crashed, Emulator
    from afspm.simulation.emulation.program import MakerProgram, NamedFile
    from afspm.simulation.emulation.scripted import (
        Client,
        OnRequest,
        ScriptedEmulator,
        ScriptFailed,
        ScriptWire,
        Unfinished,
    )
    from afspm.simulation.emulation.tcp_server import ClientConnection, TcpServer
    from afspm.simulation.faults import Faults
    from afspm.simulation.instrument import InstrumentBusy, SimulatedInstrument
    from afspm.simulation.spectra import SweptCurve
    from afspm.simulation.world import World

if TYPE_CHECKING:  # one emulated controller has it today, and another's may
    from afspm.simulation.activities import Channels
    from afspm.simulation.emulation.pending_writes import PendingWrites
    from afspm.simulation.faults import EVERY_TIME
    from afspm.simulation.ledger import LEDGER_EVENT
    from afspm.simulation.scanning import MOST_PIXELS
    from afspm.simulation.simulator import Simulator

__all__ = [
    "EVERY_TIME",
    "LEDGER_EVENT",
    "LOOPBACK",
    "MOST_PIXELS",
    "RETRACE",
    "Channels",
    "Client",
    "ClientConnection",
    "ControllerClock",
    "Crashed",
    "Emulator",
    "Faults",
    "InstrumentBusy",
    "MakerProgram",
    "NamedFile",
    "OnRequest",
    "PendingWrites",
    "ScanActivity",
    "ScriptFailed",
    "ScriptWire",
    "ScriptedEmulator",
    "SimulatedInstrument",
    "Simulator",
    "SpectrumActivity",
    "SweptCurve",
    "TcpServer",
    "Unfinished",
    "World",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.simulation.activities": "RETRACE ScanActivity SpectrumActivity Channels",
            "afspm.simulation.emulation.controller_clock": "ControllerClock",
            "afspm.simulation.emulation.emulator": "LOOPBACK Crashed Emulator",
            "afspm.simulation.emulation.pending_writes": "PendingWrites",
            "afspm.simulation.emulation.program": "MakerProgram NamedFile",
            "afspm.simulation.emulation.scripted": (
                "Client OnRequest ScriptedEmulator ScriptFailed ScriptWire Unfinished"
            ),
            "afspm.simulation.emulation.tcp_server": "ClientConnection TcpServer",
            "afspm.simulation.faults": "Faults EVERY_TIME",
            "afspm.simulation.instrument": "InstrumentBusy SimulatedInstrument",
            "afspm.simulation.ledger": "LEDGER_EVENT",
            "afspm.simulation.scanning": "MOST_PIXELS",
            "afspm.simulation.simulator": "Simulator",
            "afspm.simulation.spectra": "SweptCurve",
            "afspm.simulation.world": "World",
        },
    )
