"""Conversion of published data to the documents of the gateway."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from afspm import wire
from afspm.basics import iso_utc
from afspm.client import from_parameter
from afspm.components import Levelling, levelled
from afspm.drawing import indices, png, value_range
from afspm.model import Region, Response, names
from afspm.night import Overview, ScanSummary, SpectrumSummary
from afspm.plugins.web.frames import number_or_none
from afspm.plugins.web.gateway.models import (
    ArrayModel,
    ChannelModel,
    MicroscopeModel,
    ParameterModel,
    RegionModel,
    ScanModel,
    SpectrumModel,
    VariableModel,
)

CHUNK_BYTES = 3 << 16  # a multiple of three, so that pieces of base64 fit together


def region_model(region: Region) -> RegionModel:
    """Convert a region without validation, because the microscope published the region."""
    return RegionModel.model_construct(
        center_m=list(region.center_m), size_m=list(region.size_m), angle_rad=region.angle_rad
    )


def microscope(overview: Overview) -> MicroscopeModel:
    """Return the activity of the microscope."""
    readings = overview.readings
    parameters, probe, feedback = readings.scan_parameters, readings.probe_position, readings.feedback
    region = None if parameters is None or not isinstance(parameters.region, Region) else parameters.region
    shape = None if parameters is None or not isinstance(parameters.shape, tuple) else parameters.shape
    return MicroscopeModel.model_construct(
        state="UNDEFINED" if overview.status is None else overview.status.state.name,
        region=None if region is None else region_model(region),
        shape=None if shape is None else list(shape),
        probe_m=None if probe is None else list(probe.xy_m),
        feedback_on=None if feedback is None else feedback.on,
        setpoint=None if feedback is None or feedback.setpoint is None else number_or_none(feedback.setpoint),
    )


def scans(overview: Overview) -> list[list[ScanSummary]]:
    """Return the scans in the order of arrival, each as a list of its channels."""
    return [list(channels) for _, channels in groupby(overview.scans, lambda scan: scan.number)]


def scan_id(channels: Sequence[ScanSummary]) -> str:
    """Return the id of a scan: the time of its first channel, which a restart does not change."""
    return str(channels[0].time_ns)


def scan_model(channels: Sequence[ScanSummary]) -> ScanModel:
    """Return the document of a scan from its channels."""
    first = channels[0]
    return ScanModel.model_construct(
        id=scan_id(channels),
        number=first.number,
        began=None if first.began_ns is None else iso_utc(first.began_ns),
        finished=iso_utc(channels[-1].time_ns),
        region=region_model(first.region),
        shape=list(first.shape),
        channels=[ChannelModel(name=one.channel, unit=one.unit) for one in channels],
        holder=first.holder,
        interrupted=first.interrupted,
        file=first.filename,
    )


def spectrum_model(spectrum: SpectrumSummary) -> SpectrumModel:
    """Return the document of a spectrum without its values."""
    return SpectrumModel.model_construct(
        id=str(spectrum.time_ns),
        finished=iso_utc(spectrum.time_ns),
        kind=spectrum.kind,
        position_m=None if spectrum.position_m is None else list(spectrum.position_m),
        variables=[
            VariableModel(name=name, unit=unit, role=role)
            for name, unit, role in zip(spectrum.names, spectrum.units, spectrum.roles, strict=True)
        ],
        holder=spectrum.holder,
    )


def parameter_model(name: str, response: Response, asked: float | str | bool | None = None) -> ParameterModel:
    """Return the parameter in a response; without a payload, the requested value."""
    if not response.payload:
        return ParameterModel(name=name, value=asked, unit=names.UNITS_OF_REQUESTS.get(name) or "")
    said = wire.decode_parameter(response.payload)
    value = from_parameter(said, None)
    is_number = isinstance(value, float) and not isinstance(value, bool)
    return ParameterModel(
        name=name,
        value=number_or_none(value) if is_number and isinstance(value, float) else value,
        unit=names.UNITS_OF_REQUESTS.get(name) or said.unit or "",
    )


def as_npy(values: NDArray[np.float64]) -> Iterator[bytes]:
    """Yield an array as a .npy file in pieces, to limit memory with many clients."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": values.shape})
    yield header.getvalue()
    yield from _pieces(values)


def as_base64(values: NDArray[np.float64], units: Sequence[str]) -> Iterator[bytes]:
    """Yield an array as an `ArrayModel` in pieces."""
    model = ArrayModel.model_construct(shape=list(values.shape), units=list(units), base64="")
    head, tail = model.model_dump_json().rsplit('""', 1)
    yield f'{head}"'.encode()
    for piece in _pieces(values):
        yield base64.b64encode(piece)
    yield f'"{tail}'.encode()


def as_png(values: NDArray[np.float64], levelling: Levelling) -> bytes:
    """Return a scan as a picture, highest y on top."""
    flat = levelled(values, levelling)
    return png(indices(flat, value_range(flat)))


def _pieces(values: NDArray[np.float64]) -> Iterator[bytes]:
    flat = np.ascontiguousarray(values, dtype="<f8").reshape(-1).view(np.uint8)
    for start in range(0, flat.size, CHUNK_BYTES):
        yield flat[start : start + CHUNK_BYTES].tobytes()
