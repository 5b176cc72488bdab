"""The flip-book of a night with drift correction: the frames wander over the scanner, and stand still on the sample."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from afspm_process import AFSPM

from afspm import wire
from afspm.model import ControlMode, ControlState, Frame, Packet, Region, Scan
from afspm.record.journal import SCHEDULER
from afspm.record.store import RecordSettings, RecordStore

S = 1_000_000_000
START = 1_773_518_400 * S
STEP_M = 100e-9
SCANS = 5
CENTROID = """(name) => {
  const canvas = document.querySelector(`#flipbook [data-part=${name}]`), { width, height } = canvas;
  const pixels = canvas.getContext("2d").getImageData(0, 0, width, height).data;
  let sum = 0, count = 0;
  for (let y = 0; y < height * 0.8; y += 2) for (let x = 0; x < width; x += 2) {
    if (pixels[4 * (y * width + x) + 3] > 200) { sum += x; count += 1; }
  }
  return sum / count / width;
}"""


@pytest.fixture(scope="module")
def drifted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The record of scans of one place of a sample, which wanders by a tenth of a micrometre from scan to scan."""
    folder = tmp_path_factory.mktemp("drifted")
    (folder / "run.json").write_text(json.dumps({"name": "drifted", "ended": "the experiment has ended"}))
    store = RecordStore(folder, RecordSettings({"experiment": "drifted", "frame": "sample"}, frame=Frame.SAMPLE))
    store.take([packet(ControlState(ControlMode.AUTOMATED, "series"), START)])
    for number in range(SCANS):
        time_ns, tip_x = START + (number + 1) * 600 * S, number * STEP_M
        matrix = [1.0, 0.0, -tip_x, 0.0, 1.0, 0.0]
        mapping = wire.message_type("DriftMapping")(matrix=matrix, center=[tip_x, 0.0], correcting=True, matched=True)
        values = np.random.default_rng(number).normal(size=(32, 32)) * 1e-9
        scan = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", values, time_ns, f"s{number}.nc")
        store.take([packet(mapping, time_ns), packet(scan, time_ns + 1_000)])
    store.finish()
    store.close()
    return folder


def packet(thing: Any, time_ns: int) -> tuple[Packet, str]:
    name, payload = wire.encode(thing)
    return Packet(name, payload, time_ns), SCHEDULER


@pytest.fixture(scope="module")
def url(browser: Any, drifted: Path) -> Iterator[str]:
    """The page of that night."""
    command = (*AFSPM, "dashboard", str(drifted), "--port", "0")
    with subprocess.Popen(command, stdout=subprocess.PIPE, encoding="utf-8") as process:
        assert process.stdout is not None
        found = next(filter(None, (re.search(r"the dashboard is at (\S+);", line) for line in process.stdout)), None)
        assert found
        yield found[1]
        process.terminate()


def test_frames_wander_before_correction_and_stand_still_after(
    url: str, browser: Any, keep: Callable[[Any, str], None]
) -> None:
    page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
    page.goto(url)
    centroids = {}
    for number in (1, SCANS):
        page.wait_for_selector("#flipbook[data-shown]", state="attached")
        page.evaluate(f"(() => {{ const f = window.afspm.flipbook; f.slider.value = {number - 1}; f.show(); }})()")
        page.wait_for_selector(f"#flipbook[data-shown='{number}']")
        centroids[number] = [page.evaluate(CENTROID, name) for name in ("tip", "sample")]
    (tip_first, sample_first), (tip_last, sample_last) = centroids[1], centroids[SCANS]
    assert abs(sample_last - sample_first) < 0.01
    assert tip_last - tip_first > 0.05
    page.click("#flipbook [data-part=play]")
    page.wait_for_selector("#flipbook[data-shown='2']")
    keep(page, "flip-book")
    page.context.close()
