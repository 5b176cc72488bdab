"""Small files in the controllers' formats, made from an image and a curve that every reader must return."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from afspm.model import Feedback, Region, Scan, ScanSet, Spectrum
from afspm.plugins.park.emulator import files as park
from afspm.report.export import gwyddion, netcdf
from afspm.simulation.activities import ScanActivity, SpectrumActivity
from afspm.translator.own_files import FileFacts, encode_scan, encode_spectrum

NX, NY = 6, 4
# [y, x], both ascending; no two pixels alike, none of them zero
HEIGHT_M = (np.arange(NX * NY, dtype=np.float64).reshape(NY, NX) + 1.0) * 2.0**-30
OTHER = -HEIGHT_M
REGION = Region((3e-7, -2e-7), (50e-9, 30e-9), 0.25)
ANGLE_DEG = float(np.degrees(REGION.angle_rad))
END_NS = 1_700_000_000_000_000_000  # 2023-11-14 22:13:20 UTC


def sxm(direction: str = "up") -> bytes:
    """Nanonis: range of whole pixels, rows as recorded, backward lines from right to left, angle clockwise."""
    width, height = REGION.size_m[0] * NX / (NX - 1), REGION.size_m[1] * NY / (NY - 1)
    header = (
        f":NANONIS_VERSION:\n2\n:SCANIT_TYPE:\n              FLOAT            MSBFIRST\n"
        f":REC_DATE:\n 14.11.2023\n:REC_TIME:\n22:12:00\n:ACQ_TIME:\n       80.0\n"
        f":SCAN_PIXELS:\n       {NX}       {NY}\n:SCAN_RANGE:\n  {width!r}  {height!r}\n"
        f":SCAN_OFFSET:\n  {REGION.center_m[0]!r}  {REGION.center_m[1]!r}\n"
        f":SCAN_ANGLE:\n  {-ANGLE_DEG!r}\n:SCAN_DIR:\n{direction}\n"
        ":COMMENT:\nat 4.4 K, 30 °\n:DATA_INFO:\n\tChannel\tName\tUnit\tDirection\tCalibration\tOffset\n"
        "\t14\tZ\tm\tboth\t9.0E-9\t0.0E+0\n\t0\tCurrent\tA\tforward\t1.0E-9\t0.0E+0\n\n:SCANIT_END:\n\n\n"
    )

    def rows(image: np.ndarray) -> np.ndarray:
        return image if direction == "up" else image[::-1]

    images = [rows(HEIGHT_M), rows(OTHER)[:, ::-1], rows(OTHER)]
    return header.encode("latin-1") + b"\x1a\x04" + np.stack(images).astype(">f4").tobytes()


def dat() -> bytes:
    return (
        "Experiment\tbias spectroscopy\t\r\nSaved Date\t14.11.2023 22:13:20\t\r\nDate\t\t\r\n"
        "X (m)\t300E-9\t\r\nY (m)\t-200E-9\t\r\nStart time\t14.11.2023 22:12:00\t\r\n\r\n[DATA]\r\n"
        "Bias calc (V)\tCurrent (A)\tCurrent (A) [filt]\r\n"
        "-1.5E+0\t2E-12\tNaN\r\n0E+0\t0E+0\t1E-12\r\n1.5E+0\t-2E-12\t1E-12\r\n"
    ).encode("latin-1")


GRID_ROWS, GRID_COLUMNS = 2, 3
GRID_POINTS = 5
SEGMENTS = "Segment Start (V), Segment End (V), Settling (s), Integration (s), Steps (xn)"


def grid(*, positions: bool = True, entries: dict[str, str] | None = None) -> bytes:
    """Return a Nanonis grid over `REGION`: record by record the parameters, then each channel.

    Point k has the height k nm; current and its backward sweep at sweep point j are 100 k + j and its negative, in pA.
    """
    points = GRID_ROWS * GRID_COLUMNS
    pixels = GRID_COLUMNS, GRID_ROWS
    size_m = [size * count / (count - 1) for size, count in zip(REGION.size_m, pixels, strict=True)]
    frame = [*REGION.center_m, *size_m, -ANGLE_DEG]
    places = "X (m);Y (m);" if positions else ""
    header = {
        "Grid dim": f'"{GRID_COLUMNS} x {GRID_ROWS}"',
        "Grid settings": ";".join(map(repr, frame)),
        "Filetype": "Linear",
        "Sweep Signal": '"Bias (V)"',
        "Fixed parameters": '"Sweep Start;Sweep End"',
        "Experiment parameters": f'"{places}Z (m);Settling time (s);Scan:Current (A)"',
        "# Parameters (4 byte)": "7" if positions else "5",
        "Points": str(GRID_POINTS),
        "Channels": '"Current (A);Current [bwd] (A)"',
        "Experiment": '"Grid Spectroscopy"',
        "Start time": '"14.11.2023 22:12:00"',
        "End time": '"14.11.2023 22:13:20"',
        "Comment": '"at 4.4 K, 30 \xb0"',
    } | (entries or {})
    k = np.arange(points)
    x, y = (axis.ravel() for axis in REGION.pixels_m((GRID_ROWS, GRID_COLUMNS)))
    sweep = [np.full(points, 1.0), np.full(points, -1.0)]
    once = [k * 1e-9, np.full(points, 0.02), k * 1e-12]
    currents = (100 * k[:, None] + np.arange(GRID_POINTS)) * 1e-12
    records = np.column_stack([*sweep, *([x, y] if positions else []), *once, currents, -currents])
    lines = "".join(f"{key}={value}\r\n" for key, value in header.items())
    return lines.encode("cp1252") + b":HEADER_END:\r\n" + records.astype(">f4").tobytes()


def wave(values: np.ndarray, unit: str, steps: tuple[float, ...], labels: list[str], note: str) -> bytes:
    """An Igor binary wave of version 5 (Technical Note 003), its last dimension labelled; `unit` of the others."""
    text = b"".join(name.encode().ljust(32, b"\0") for name in ["", *labels])
    raw, body = note.encode("latin-1"), values.astype("<f4").tobytes(order="F")
    last = values.ndim - 1
    units = [unit.encode() if k < last else b"" for k in range(4)]
    label_sizes = [len(text) if k == last else 0 for k in range(4)]
    sizes = struct.pack("<4i4i4i3i", 320 + len(body), 0, len(raw), 0, *[0] * 4, *label_sizes, 0, 0, 0)
    head = struct.pack("<3I i hh 6x h 32s 8x", 0, 0, 0, values.size, 2, 0, 5, b"scan0001")
    head += struct.pack("<4i 4d 32x", *[*values.shape, 0, 0][:4], *[*steps, 1.0, 1.0, 1.0][:4])
    head += b"".join(u.ljust(4, b"\0") for u in [b"m", *units])
    header = bytearray(struct.pack("<hH", 5, 0) + sizes + head.ljust(320, b"\0"))
    struct.pack_into("<H", header, 2, -int(np.frombuffer(header, "<i2").sum(dtype=np.int64)) & 0xFFFF)
    return bytes(header) + body + raw + text


NOTE = (
    f"XOffset: 3e-07\rYOffset: -2e-07\rScanAngle: {-ANGLE_DEG!r}\rScanDown: 1\rScanRate: 2\rNapMode: 0\r"
    "StartHeadTemp: 30 °C\rSeconds:3782844800\rXLVDT:1e-6\rYLVDT:-2e-6\rInitial ScanRate: 7"
)


def ibw() -> bytes:
    """Return [x, y, channel], both ascending for either scan direction."""
    square = np.stack([HEIGHT_M.T, OTHER.T], axis=2)
    return wave(square, "m", (10e-9, 10e-9), ["HeightRetrace", "PhaseRetrace"], NOTE)


def force() -> bytes:
    return wave(np.arange(6.0).reshape(3, 2) / 8, "s", (0.5,), ["Raw", "Defl"], NOTE)


def gsf() -> bytes:
    header = (
        f"Gwyddion Simple Field 1.0\nXRes = {NX}\nYRes = {NY}\nXReal = 6e-8\nYReal = 4e-8\n"
        "XOffset = 1e-7\nXYUnits = m\nZUnits = m\nTitle = Height\n"
    ).encode()
    return header + b"\0" * (4 - len(header) % 4) + HEIGHT_M[::-1].astype("<f4").tobytes()


def simulated() -> bytes:
    attributes: dict[str, str | float] = {"scan-speed [m/s]": 1e-8, "x-scan-direction": "down"}
    channels = {"Height Retrace": ("m", HEIGHT_M), "Phase": ("deg", OTHER)}
    return encode_scan(REGION, channels, FileFacts(END_NS, attributes))


def simulated_spectrum() -> bytes:
    curve = Spectrum((1e-9, -2e-9), "IV", ("Bias", "Current"), ("V", "A"), np.arange(6.0).reshape(3, 2))
    return encode_spectrum(curve, FileFacts(END_NS, {}))


def exported_scans() -> ScanSet:
    return ScanSet([Scan(REGION, "Height", "m", HEIGHT_M, END_NS), Scan(REGION, "Phase", "deg", OTHER, END_NS)])


def exported_nc() -> bytes:
    return netcdf.scan_file(exported_scans(), {}, {"time_ns": END_NS, "began_ns": None, "controller": ""})


def exported_gwy() -> bytes:
    about = {"center_m": REGION.center_m, "size_m": REGION.size_m, "angle_rad": REGION.angle_rad}
    meta = gwyddion.meta_of(about | {"frame": "tip", "time_ns": END_NS})
    return gwyddion.scan_file([*exported_scans().values()], meta)


def vpdata() -> bytes:
    return (
        "# GXSM Vector Probe Data :: VPVersion=00.02 vdate=20070227\n# Date   :: date=Tue Nov 14 22:13:20 2023\n#\n"
        "# Probe Data Number      :: N=3\n#C \n#C Data Table             :: data=\n"
        '#C Index\t"Bias-mon (V)"\t"Z-mon (Å)"\t"Bias-mon (V)"\tBlock-Start-Index\n'
        "0\t-1.5e+00\t1.0e+01\t-1.5e+00\t0\n1\t0.0e+00\t2.0e+01\t0.0e+00\t2e-314\n2\t1.5e+00\t3.0e+01\t1.5e+00\t0\n"
        "#C \n#C END.\n"
    ).encode()


def gxsm_numbers() -> dict[str, float]:
    """Lengths in Å; the angle is clockwise; the range is from the first pixel to the last."""
    return {
        "rangex": 500.0, "rangey": 300.0, "offsetx": 3000.0, "offsety": -2000.0,
        "alpha": -ANGLE_DEG, "dz": 0.5,
    }  # fmt: skip


def gxsm_field(stopped: int = 0) -> np.ndarray:
    """Rows from the top, in units of dz; the last ones zero if it was stopped."""
    field = (HEIGHT_M[::-1] * 1e10 / 0.5).astype(np.float32)[None, None]
    if stopped:
        field[:, :, -stopped:] = 0.0
    return field


def gxsm3(path: Path, stopped: int = 0) -> None:
    from scipy.io import netcdf_file

    file: Any
    with netcdf_file(path, "w", version=1) as file:
        file.Creator, file.Version = b"gxsm3", b"1.2.3"
        for name, size in (("time", 1), ("value", 1), ("dimy", NY), ("dimx", NX), ("text", 8), ("name", 24)):
            file.createDimension(name, size)
        field = file.createVariable("FloatField", "f4", ("time", "value", "dimy", "dimx"))
        field[:] = gxsm_field(stopped)
        field.ZSrcUnit, field.ZLabel = b"AA", b"Z"
        for name, value in gxsm_numbers().items():
            file.createVariable(name, "f8", ()).data[...] = value
        for name, value in (("t_start", END_NS // 10**9 - 80), ("t_end", END_NS // 10**9)):
            file.createVariable(name, "i4", ()).data[...] = value
        file.createVariable("spm_scancontrol", "c", ("text",))[:] = np.array(list("TopDown "), dtype="S1")
        file.createVariable("basename", "c", ("name",))[:] = np.array(list("/d/scan002-M-Xp-Topo.nc\0"), dtype="S1")


def gxsm4(path: Path, stopped: int = 0) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file.attrs["Creator"], file.attrs["Version"] = np.bytes_(b"gxsm4"), np.bytes_(b"1.2.3")
        field = file.create_dataset("FloatField", data=gxsm_field(stopped))
        field.attrs["ZSrcUnit"], field.attrs["ZLabel"] = np.bytes_(b"AA"), np.bytes_(b"ZS-Topo")
        for name, value in gxsm_numbers().items():
            file[name] = value
        file["t_start"], file["t_end"] = END_NS // 10**9 - 80, END_NS // 10**9
        file["spm_scancontrol"] = np.array(list("TopDown "), dtype="S1")
        file["basename"] = np.array(list("/d/scan002-M-Xp-ZSmTopo.nc\0"), dtype="S1")


def nsid(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for k, (name, image) in enumerate((("HeightRetrace", HEIGHT_M), ("PhaseRetrace", OTHER))):
            group = file.create_group(f"Measurement_000/Channel_{k}/Channel_{k}")
            data = group.create_dataset(f"Channel_{k}", data=image.T.astype(np.float32))
            data.attrs["quantity"], data.attrs["units"] = name, "m"
            group["x"], group["y"] = np.linspace(0, 50e-9, NX), np.linspace(0, 30e-9, NY)
            note = group.create_group("original_metadata").attrs
            for line in NOTE.split("\r"):
                key, _, value = line.partition(":")
                note[key] = value.strip()


def nexus_image(
    path: Path, *, program: str = "Nanonis", angle_deg: float = -ANGLE_DEG, unit: str = "m", transposed: bool = False
) -> None:
    """Write an image as NXspm, like pynxtools-spm since 2026: y descends, the angle is not applied to the axes."""
    import h5py

    per_m = {"m": 1.0, "nm": 1e9}[unit]
    (x, y), (width, height) = REGION.center_m, REGION.size_m
    axes = {"x": np.linspace(x - width / 2, x + width / 2, NX), "y": np.linspace(y + height / 2, y - height / 2, NY)}
    with h5py.File(path, "w") as file:
        file.attrs["NX_class"] = "NXroot"
        entry = file.create_group("entry")
        entry.attrs["NX_class"], entry["definition"] = "NXentry", "NXspm"
        entry["start_time"], entry["end_time"] = "2023-11-14T23:12:00+01:00", "2023-11-14T23:13:20+01:00"
        entry["instrument/software/name"] = program
        region = entry.create_group("instrument/scan_region")
        region.attrs["NX_class"] = "NXspm_scan_region"
        for (axis, center), size in zip((("x", x), ("y", y)), REGION.size_m, strict=True):
            pixels = {"x": NX, "y": NY}[axis]
            whole = size * pixels / (pixels - 1)
            facts = {"offset_value": center, "range": whole, "start": center - whole / 2, "end": center + whole / 2}
            for name, value in facts.items():
                region[f"scan_{name}_{axis}"] = value
                region[f"scan_{name}_{axis}"].attrs["units"] = "meter"
        region["scan_angle_x"] = angle_deg
        region["scan_angle_x"].attrs["units"] = "degree"
        for name, values, of in (("z_forward", HEIGHT_M, "meter"), ("phase_forward", OTHER, "degree")):
            data = entry.create_group(name)
            data.attrs["NX_class"], data.attrs["signal"] = "NXdata", "signal"
            data.attrs["axes"] = ["x", "y"] if transposed else ["y", "x"]
            data["signal"] = values[::-1].T if transposed else values[::-1]
            data["signal"].attrs["units"] = of
            for axis, places in axes.items():
                data[axis] = places * per_m
                data[axis].attrs["units"] = unit


def nhf(path: Path) -> None:
    """Write a file of format 1, like the maker's example."""
    import h5py

    with h5py.File(path, "w") as file:
        file.attrs["nsf_file_version_major"], file.attrs["nsf_file_version_minor"] = np.uint32(1), np.uint32(1)
        group = file.create_group("measurement_0")
        group.attrs.update(measurement_type="image_line_based", created="2023-07-18T15:26:38.320Z", name="Image 1")
        group.attrs.update(image_points_per_line=NX, image_number_of_lines=NY, image_scan_direction="up")
        group.attrs.update(image_size_x=50e-9, image_size_y=30e-9, scanner_offset_x=1e-7, scanner_rotation=10.0)
        for k, way in enumerate(("Forward", "Backward")):
            segment = group.create_group(f"segment_{k}")
            segment.attrs["name"] = way
            values = np.rint(HEIGHT_M / 1e-6 * 2**31).astype(np.int32).ravel()
            data = segment.create_dataset("dataset_0", data=values)
            data.attrs.update(name="Topography", base_calibration_unit="m", dataset_element_type=np.uint32(0))
            data.attrs.update(base_calibration_min=-1e-6, base_calibration_max=1e-6)


def nid() -> bytes:
    """Return a file with an image and a curve of two lines."""
    image = (
        f"Version=2\r\nPoints={NX}\r\nLines={NY}\r\nFrame=Scan forward\r\nDim0Unit=m\r\nDim0Range=5e-08\r\n"
        "Dim1Range=3e-08\r\nDim2Name=Z-Axis\r\nDim2Unit=m\r\nDim2Range=2e-06\r\nDim2Min=-1e-06\r\nSaveBits=32\r\n"
    )
    curve = (
        "Version=3\r\nPoints=4\r\nLines=2\r\nFrame=Spec forward\r\nDim0Name=Z-Axis\r\nDim0Unit=m\r\nDim0Range=1e-06\r\n"
        "Dim0Min=0\r\nDim2Name=Deflection\r\nDim2Unit=N\r\nDim2Range=4e-06\r\nDim2Min=-2e-06\r\nLineDim1Min=0\r\n"
        "LineDim1Range=5e-07\r\nLineDim1Points=3\r\nSaveBits=32\r\n"
    )
    head = (
        "[DataSet]\r\nVersion=2\r\nGroupCount=2\r\nGr0-Count=8\r\nGr1-Count=8\r\nGr0-Ch1=DataSet-0:1\r\n"
        f"Gr1-Ch0=DataSet-1:0\r\n\r\n[DataSet-0:1]\r\n{image}\r\n[DataSet-1:0]\r\n{curve}\r\n"
    )
    values = np.rint(HEIGHT_M / 1e-6 * 2**31).astype("<i4").tobytes()
    return head.encode() + b"#!" + values + np.arange(8, dtype="<i4").tobytes()


def park_image() -> bytes:
    scan = ScanActivity(1, REGION, (NY, NX), 0.0, 0.5, True, Feedback(setpoint=0.7), 0.2)
    scan.draw(DrawnScan())
    return next(content for _, content in park.images(scan, END_NS / 1e9, "NCM"))


def park_curve() -> bytes:
    values = np.stack([np.arange(5.0) * 1e-7, np.arange(5.0) * 1e-9], axis=1)
    taken = SpectrumActivity(1, "force", REGION.center_m, 0.0, 1.0, ("Z", "Force"), ("m", "N"), values)
    return park.curve(taken, END_NS / 1e9, "NCM")


class DrawnScan:
    def channels(self, until_s: float | None = None) -> dict[str, tuple[str, np.ndarray]]:
        return {"Z Height": ("m", HEIGHT_M)}


def written(content: Callable[[], bytes]) -> Callable[[Path], None]:
    return lambda path: (path.write_bytes(content()), None)[1]


# Of every format one that is whole: name, and what makes it.
WHOLE: dict[str, Callable[[Path], None]] = {
    "up.sxm": written(sxm),
    "down.sxm": written(lambda: sxm("down")),
    "spectrum.dat": written(dat),
    "grid.3ds": written(grid),
    "scan.ibw": written(ibw),
    "force.ibw": written(force),
    "field.gsf": written(gsf),
    "simulated.nc": written(simulated),
    "simulated-spectrum.nc": written(simulated_spectrum),
    "exported.nc": written(exported_nc),
    "exported.gwy": written(exported_gwy),
    "gxsm3.nc": gxsm3,
    "gxsm4.nc": gxsm4,
    "curve-VP001-VP.vpdata": written(vpdata),
    "nsid.h5": nsid,
    "image.nxs": nexus_image,
    "image.nhf": nhf,
    "image.nid": written(nid),
    "image.tiff": written(park_image),
    "curve.tiff": written(park_curve),
}
