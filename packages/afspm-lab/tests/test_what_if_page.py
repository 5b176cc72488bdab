"""The page of `afspm what-if`, of a real record and of made ones."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import what_if_lab as lab
from typer.testing import CliRunner

import afspm
from afspm import Memory, open_run, wire
from afspm.basics import day_and_time
from afspm.model import Region
from afspm.wire.generated import analysis_pb2
from afspm_lab.what_if.alignment import Difference, Output, PacketName
from afspm_lab.what_if.commands import DIFFERS, app
from afspm_lab.what_if.component_replay import ComponentReplay
from afspm_lab.what_if.page import DifferencePage
from afspm_lab.what_if.side_by_side import ChangedField, changed_fields
from afspm_lab.what_if.what_if import WhatIf


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("night")
    lab.record(folder, {"judge": lab.Judge()})
    return folder


class _Read(HTMLParser):
    """The rows of all tables as texts, all tags, and the whole text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.tags: list[str] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
        if tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data


def test_page_shows_the_first_difference(night: Path, tmp_path: Path) -> None:
    target = tmp_path / "page.html"
    result = CliRunner().invoke(app, [str(night), "--set", "judge.factor=0.0", "--page", str(target)])
    assert result.exit_code == DIFFERS, result.output
    assert str(target) in result.output.replace("\n", "")
    page = _Read(target.read_text(encoding="utf-8"))
    with open_run(night) as run:
        scans = [one for one in run.packets(messages=["Scan2d"]) if one.envelope.endswith(lab.CHANNEL)]
    remarks = _remarks([wire.decode("Scan2d", one.payload) for one in scans])
    packet = next(one for one, remark in list(zip(scans, remarks, strict=True))[1:] if remark == "smooth")
    assert packet.time_ns
    when = day_and_time(packet.time_ns, UTC)
    assert f"judge, {when}, at the packet {packet.envelope}, changed: Note" in page.text
    assert ["text", "smooth", "rough"] in page.rows
    assert [when, "judge", packet.envelope, "changed", "Note\ntext: smooth", "Note\ntext: rough"] in page.rows
    assert ["judge.factor", "0.0"] in page.rows
    judge = next(row for row in page.rows if row[0] == "judge")
    assert judge[2:4] == ["0", "0"]
    assert judge[6] == "the unchanged component repeats its record"


def _remarks(scans: list[afspm.Scan]) -> list[str]:
    judge = lab.Judge()
    judge.memory = Memory(None)
    return [judge.remark(scan) for scan in scans]


def test_page_without_a_difference_names_none(night: Path, tmp_path: Path) -> None:
    target = tmp_path / "page.html"
    result = CliRunner().invoke(app, [str(night), "--component", "judge", "--json", "--page", str(target)])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["differs"] is False  # the name of the page is not among the JSON
    page = _Read(target.read_text(encoding="utf-8"))
    assert "no difference" in page.text
    assert "First difference" not in page.text
    assert [row[0] for row in page.rows] == ["process", "judge"]
    assert "series was not replayed: only others were chosen" in page.text


def test_page_marks_counterfactual_differences_and_escapes_texts() -> None:
    def output(text: str, at_ns: int, *, reaches: bool = False) -> Output:
        return Output("Remark<i>", "", text, text, PacketName(at_ns, "Scan<i>"), at_ns, 1, reaches)

    result = WhatIf(Path("<i>night"), unread={"<i>other": "<i>broken"}, simulated=True)
    result.components["<i>judge"] = ComponentReplay(
        "<i>judge",
        [output("<i>a", 10**9, reaches=True), output("<i>b", 2 * 10**9)],
        [output("<i>c", 2 * 10**9), output("<i>d", 3 * 10**9)],
        ["<i>reads"],
    )
    same = WhatIf(Path("same"))
    page = DifferencePage({"<i>judge": {"<i>factor": "<i>1"}})
    page.add(result)
    page.add(same)
    read = _Read(page.html())
    assert "i" not in read.tags
    assert "1 of 2 differ" in read.text
    assert "SIMULATED" in read.text
    assert "<i>other was not replayed: <i>broken" in read.text
    assert "<i>judge depends on more than its inputs: it <i>reads" in read.text
    kinds = {tuple(row[3:]) for row in read.rows if len(row) == 6 and row[0].startswith("1970")}
    assert ("changed", "<i>a", "Remark<i>: <i>d") in kinds
    assert ("changedcounterfactual", "Remark<i>: <i>b", "Remark<i>: <i>c") in kinds


def test_changed_fields_of_generated_messages_and_arrays_are_named() -> None:
    def output(thing: object) -> Output:
        name, payload = wire.encode(thing)
        return Output(name, "", bytes(payload), "", None, 0, 1)

    def fields(before: object, after: object) -> list[ChangedField]:
        return changed_fields(Difference("judge", output(before), output(after)))

    scored = [analysis_pb2.SpatialROIWithScoreList(spatials=[{"score": score}]) for score in (0.5, 1.0)]
    assert fields(*scored) == [("spatials[0].score", "0.5", "1.0")]
    flat = afspm.Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.zeros((2, 3)))
    assert fields(flat, flat) == []
    assert len(fields(flat, replace(flat, channel="Phase"))) == 1
    ((name, before, after),) = fields(flat, replace(flat, values=np.ones((2, 3))))
    assert name == "values"
    assert before.startswith("2 × 3 values")
    assert before != after
