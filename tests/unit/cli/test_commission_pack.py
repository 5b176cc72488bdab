"""The folder of a commissioning for others: complete, and without private texts."""

from __future__ import annotations

import csv
import getpass
import json
from pathlib import Path

import numpy as np
import pytest

from afspm.basics.errors import FileError
from afspm.cli import commission_pack
from afspm.model import Region, Scan
from afspm.translator.trace import FILE, TracedExchange, TraceHeader, TraceLine, written_line

FOLDER = r"C:\Users\Ada Lovelace\Session"
VALUES = np.arange(12.0).reshape(3, 4)
SCAN = Scan(Region((0.0, 0.0), (1e-7, 1e-7)), "Z Forward", "m", VALUES, filename=rf"{FOLDER}\gold_on_mica0001.sxm")


@pytest.fixture
def evening(tmp_path: Path) -> tuple[Path, Path]:
    """Return a report and a run folder that name a person."""
    answered = FOLDER.encode()
    lines: list[TraceLine] = [
        TraceHeader("Nanonis", "0.1.0", "2026-11-30T12:00:00Z"),
        TracedExchange(
            0, "tcp", "Util.SessionPathGet", b"?", len(answered).to_bytes(4, "big") + answered, 0, took_s=0.25
        ),
        *(TracedExchange(0, "tcp", "Bias.Get", b"?", b"1", 0, took_s=took_s) for took_s in (0.001, 0.003, 0.002)),
        TracedExchange(0, "tcp", "Bias.Get", b"?", b"", 0, lost="no answer", took_s=5.0),
    ]
    run = tmp_path / "run"
    run.mkdir()
    (run / FILE).write_text("".join(f"{written_line(line)}\n" for line in lines), encoding="utf-8")
    report = tmp_path / "report.toml"
    report.write_text(json.dumps(f"a file in {FOLDER} by {getpass.getuser()}_"), encoding="utf-8")
    return report, run


def test_folder_has_all_that_its_page_lists_and_nothing_private(evening: tuple[Path, Path], tmp_path: Path) -> None:
    folder = tmp_path / "to-send"
    commission_pack.write(folder, *evening, {"in-the-air": [SCAN]})
    commission_pack.write(folder, *evening, {"at-the-sample": [SCAN]})  # another evening
    names = {file.name for file in folder.iterdir()}
    assert names == {"README.md", "report.toml", "timings.csv", "versions.json", "in-the-air.nc", "at-the-sample.nc"}
    page = (folder / "README.md").read_text(encoding="utf-8")
    assert [name for name in names - {"README.md"} if f"`{name}`" not in page] == []
    everything = b"".join(file.read_bytes() for file in folder.iterdir())
    assert not [word for word in (b"Ada", b"Lovelace", b"gold_on_mica") if word in everything]
    rows = {row["question"]: row for row in csv.DictReader((folder / "timings.csv").read_text("utf-8").splitlines())}
    assert rows["Bias.Get"] == {
        "question": "Bias.Get", "asked": "4", "median_ms": "2.5", "longest_ms": "5000.0", "unanswered": "1",
    }  # fmt: skip


def test_another_folder_of_that_name_stays(evening: tuple[Path, Path], tmp_path: Path) -> None:
    folder = tmp_path / "to-send"
    folder.mkdir()
    (folder / "README.md").write_text("my own notes", encoding="utf-8")
    with pytest.raises(FileError, match="is another folder"):
        commission_pack.write(folder, *evening, {})
    assert [file.name for file in folder.iterdir()] == ["README.md"]
