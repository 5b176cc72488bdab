"""A commissioning as a folder for others: its report, the time of each question, two scans, without private texts."""

from __future__ import annotations

import csv
import json
import platform
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Final

from afspm.basics.errors import FileError
from afspm.cli.shadow_pack import Mask, of_this_computer, of_trace, replaceable, require_clean, traced
from afspm.model import Scan, ScanSet
from afspm.report.export.netcdf import scan_file
from afspm.translator.trace import FILE, TracedExchange

_PAGE: Final = "README.md"
_TEXT: Final = """# An evening of `afspm commission`

Send this folder: it is evidence on a controller that its drivers lack (docs/reference/instruments.md says where to).

| file | content |
| --- | --- |
| `report.toml` | the outcome and the line of each step, and the verdict on each claim about the maker's program |
| `timings.csv` | each question to the controller: how often it was asked, and how long its answers took |
| `versions.json` | afspm, Python, operating system |
| `in-the-air.nc`, `at-the-sample.nc` | one scan each, all channels, as netCDF, as far as they were taken |

It has no trace, no log and no experiment file. Names of people and of this computer, folders, and names and written
entries of the controller's files are replaced by x, also in the scans. {replaced} texts were replaced:

{private}
Look at each file before you send it: a name that stands in none of these places is not known to afspm.
"""


def write(folder: Path, report: Path, run: Path, scans: Mapping[str, Sequence[Scan]]) -> None:
    """Write the folder; in one of an earlier evening, scans that were not taken again stay.

    Args:
        report: the file of the report.
        run: the run folder, with the trace.
        scans: the scans to send, all channels each, by the name of their file.

    Raises:
        FileError: the folder is another one, can't be written, or still has a private text.
    """
    traces = sorted(run.glob(f"*{FILE}"))
    private, short = replaceable([*of_this_computer(platform.node()), *of_trace(traces)], traces)
    mask = Mask(private)
    try:
        head = _TEXT.partition("\n")[0]
        if folder.exists() and not (folder / _PAGE).read_text(encoding="utf-8").startswith(head):
            raise FileError("is another folder: move it away", where=str(folder))
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "report.toml").write_bytes(mask.of(report.read_bytes()))
        _write_timings(folder / "timings.csv", traces)
        (folder / "versions.json").write_text(json.dumps(_versions(), indent=2) + "\n", encoding="utf-8")
        for name, channels in scans.items():
            content = scan_file(ScanSet(replace(one, filename="") for one in channels), {}, {})
            (folder / f"{name}.nc").write_bytes(mask.of(content))
        places = "".join(f"- {place}\n" for place in dict.fromkeys(one.where for one in private))
        kept = "".join(f"- **not replaced**, too short or a word of the protocol: {one.where}\n" for one in short)
        text = _TEXT.format(replaced=len(private), private=places + kept)
        (folder / _PAGE).write_text(text, encoding="utf-8")
    except OSError as error:
        raise FileError(f"can't be written: {error}", where=str(folder)) from error
    require_clean(folder, mask)


def _versions() -> dict[str, str]:
    return {"afspm": version("afspm"), "python": platform.python_version(), "system": platform.platform()}


def _write_timings(file: Path, traces: Sequence[Path]) -> None:
    took_s: dict[str, list[float]] = defaultdict(list)
    lost: dict[str, int] = defaultdict(int)
    for line in traced(traces):
        if isinstance(line, TracedExchange):
            took_s[line.what].append(line.took_s)
            lost[line.what] += bool(line.lost) and not line.answered
    with file.open("w", encoding="utf-8", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["question", "asked", "median_ms", "longest_ms", "unanswered"])
        for what, of in sorted(took_s.items()):
            rows.writerow([what, len(of), f"{1e3 * median(of):.1f}", f"{1e3 * max(of):.1f}", lost[what]])
