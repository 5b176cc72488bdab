"""Packets as a scheduler publishes them, and a record of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from afspm import wire
from afspm.model import (
    ControlMode,
    ControlState,
    Feedback,
    Packet,
    Region,
    RegistrationOutcome,
    Scan,
    ScanLines,
    ScopeState,
    ScopeStatus,
    Spectrum,
)
from afspm.record.journal import SCHEDULER
from afspm.record.store import RecordSettings

START_NS = 1_773_518_400_000_000_000
REGION = Region((1e-6, -2e-6), (1e-6, 0.5e-6), 0.25)
ABOUT = RecordSettings({"experiment": "night", "simulated": True, "seeds": {"microscope": 7}, "frame": "tip"})
Given = tuple[Packet, str]


class Night:
    """Creates packets, one after the other, 1 ms apart."""

    def __init__(self) -> None:
        self.now_ns = START_NS
        self.random = np.random.default_rng(1)

    def packet(self, thing: Any, envelope: str = "") -> Given:
        name, payload = wire.encode(thing)
        self.now_ns += 1_000_000
        return Packet(envelope or name, payload, self.now_ns), SCHEDULER

    def state(self, state: ScopeState) -> Given:
        return self.packet(ScopeStatus(state))

    def control(self, holder: str | None = "series", problems: tuple[int, ...] = ()) -> Given:
        return self.packet(ControlState(ControlMode.AUTOMATED, holder, problems))

    def feedback(self) -> Given:
        return self.packet(Feedback(True, 0.125, 1500.0, 0.75))

    def scans(
        self, number: int, channels: tuple[str, ...] = ("Height", "Height Retrace"), time_ns: int | None = None
    ) -> list[Given]:
        filename, time_ns = f"scan-{number:04d}.nc", self.now_ns if time_ns is None else time_ns
        made = [Scan(REGION, name, "m", self.random.normal(size=(6, 8)), time_ns, filename) for name in channels]
        return [self.packet(scan, f"Scan2d_1000.0_{scan.channel}") for scan in made]

    def scan_in_files(self, number: int, channels: tuple[str, ...] = ("Topo", "Current", "Phase")) -> list[Given]:
        """Return the channels of a scan, as from a controller that writes a file for each channel."""
        time_ns = self.now_ns
        values = self.random.normal(size=(len(channels), 6, 8))
        made = [
            Scan(REGION, name, "m", z, time_ns, f"s{number}-{name}.nc")
            for name, z in zip(channels, values, strict=True)
        ]
        return [self.packet(scan, f"Scan2d_1000.0_{scan.channel}") for scan in made]

    def lines(self, rows: int = 2, first: int = 0, channel: str = "Height") -> Given:
        values = self.random.normal(size=(rows, 8))
        return self.packet(ScanLines(REGION, (6, 8), channel, "m", first, values, self.now_ns))

    def spectrum(self, number: int = 1) -> Given:
        values = self.random.normal(size=(20, 3))
        spectrum = Spectrum((1e-6, 2e-6), "IV", ("Bias", "Current", "dI/dV"), ("V", "A", "S"), values, self.now_ns, "s")
        return self.packet(spectrum, "Spec1d_IV")

    def whole_scan(self, number: int) -> list[Given]:
        """Return the packets of a scan from start to end."""
        scanning = self.state(ScopeState.SCANNING)
        return [scanning, *self.scans(number), self.state(ScopeState.FREE)]

    def registered_scan(self, number: int, outcome: RegistrationOutcome, sd_m: float) -> list[Given]:
        """Return a scan with its mapping just before it, as a Drift Compensated Scheduler publishes them."""
        scanning = self.state(ScopeState.SCANNING)
        message: Any = wire.message_type("DriftMapping")(
            matrix=[1, 0, 0, 0, 1, 0], center=[0, 0], covariance=[sd_m**2, 0, 0, sd_m**2], outcome=int(outcome),
            matched=outcome.is_registered, reason="oh", filename=f"scan-{number:04d}.nc",
        )  # fmt: skip
        message.timestamp.FromNanoseconds(self.now_ns)
        return [scanning, self.packet(message), *self.scans(number), self.state(ScopeState.FREE)]


def same(recorded: list[Packet], given: list[Given]) -> bool:
    """Return whether the packets agree with the given ones, bit by bit."""
    wanted = [packet for packet, _ in given]
    return [(p.envelope, p.time_ns, bytes(p.payload)) for p in recorded] == [
        (p.envelope, p.time_ns, bytes(p.payload)) for p in wanted
    ]
