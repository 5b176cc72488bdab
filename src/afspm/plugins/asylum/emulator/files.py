"""The files of scans and force curves: made as Asylum makes them, and written late and in parts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from afspm.plugins.asylum.emulator import ibw
from afspm.plugins.asylum.emulator.values import IgorValues
from afspm.simulation.activities import ScanActivity, SpectrumActivity

AMPLITUDE_M_PER_V = 1e-7

Entries = Mapping[str, float | str]
Made = Callable[[str], bytes]
"""The content of a file, given the name of its wave."""


def image(name: str, scan: ScanActivity, values: IgorValues, now_s: float) -> bytes:
    """The file of a scan; lines that were not scanned are NaN."""
    channels = scan.channels(scan.end_s if scan.stopped_s is not None else None)
    layers, labels = [], []
    for channel, (unit, found) in channels.items():
        quantity, _, back = channel.partition(" ")
        labels.append(f"{quantity.replace(' ', '')}{back or 'Trace'}")
        # an amplitude is noted as a length
        layers.append((found * AMPLITUDE_M_PER_V if (quantity, unit) == ("Amplitude", "V") else found).T)
    rows, columns = scan.shape
    width, height = scan.region.size_m
    steps = [(width / (columns - 1), "m"), (height / (rows - 1), "m")]
    return ibw.wave(name, np.stack(layers, axis=2), "m", steps, labels, _note(values, now_s), now_s)


def curve(name: str, spectrum: SpectrumActivity, values: IgorValues, now_s: float) -> bytes:
    """The file of a force curve: towards the sample and back, over time."""
    table = dict(zip(spectrum.names, spectrum.values.T, strict=True))
    extension = table["Z"].max() - table["Z"]
    there_and_back: Sequence[np.ndarray] = [
        np.concatenate([extension[::-1], extension]),
        np.concatenate([table["Deflection"][::-1], table["Deflection Retrace"]]),
    ]
    columns = np.column_stack([*there_and_back, there_and_back[0]])
    step_s = (spectrum.end_s - spectrum.start_s) / len(columns)
    noted = _of_curve(spectrum, float(np.ptp(extension)), columns.shape[0], values)
    return ibw.wave(name, columns, "m", [(step_s, "s")], ["Raw", "Defl", "ZSnsr"], _note(values, now_s, noted), now_s)


def _of_curve(spectrum: SpectrumActivity, distance_m: float, points: int, values: IgorValues) -> Entries:
    """Return the entries of a force curve's note that describe its acquisition."""
    duration_s = spectrum.end_s - spectrum.start_s
    velocity_m_s = distance_m / (duration_s / 2)
    place = zip(("XLVDT", "YLVDT"), spectrum.position_m, strict=True)
    return {
        **dict(place),
        "ImagingMode": "Contact",
        "ForceDist": distance_m,
        "ForceScanRate": 1.0 / duration_s,
        "NumPtsPerSec": points / duration_s,
        "InputTime": duration_s,
        "ApproachVelocity": velocity_m_s,
        "RetractVelocity": velocity_m_s,
        "TriggerChannel": "DeflVolts",
        "TriggerPoint": values.get("DeflectionSetpointVolts"),
        "Indexes": f"0,{points // 2},{points - 1}",
        "Direction": "NaN,1,-1,",
    }


def _note(values: IgorValues, now_s: float, more: Entries = MappingProxyType({})) -> bytes:
    local, seconds = ibw.moment(now_s)
    texts = {
        "StartHeadTemp": "32.125 °C",
        "Date": f"{local:%Y-%m-%d}",
        "Time": f"{local:%H:%M:%S}",
        "Seconds": f"{seconds:.3f}",
        "SaveImage": values.text("SaveImage"),  # the second of this name, as in real notes
        "MicroscopeModel": "afspm SIMULATED",
        "Version": "15.09.112",
        "BaseName": values.text("BaseName"),
    }
    numbers = ((name, value) for name, value in values.noted() if name not in more)
    return ibw.note([*numbers, *more.items(), *texts.items()])
