"""A controller crashes during a scan: a malfunction is flagged, and the night goes on after its return."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from makers import MAKERS
from tests.system.experiment.experiment_lab import WITNESS, AfspmRun

FILES = Path(__file__).parents[3] / "experiments" / "every_microscope"
TIMED = sorted(name for name, maker in MAKERS.items() if maker.takes("reply_timeout_s"))
SCANS = 3
OVERLAY = """
[clock]
speed = 10.0

[control]
malfunction_after = "0.2 s"

[microscope]
address = "{address}"
reply_timeout_s = "1 s"

[details]
end_when_done = false

[witness]
component = true
class = "witness.Witness"
scans = 3

[cache]
history = {{ Scan2d = 20 }}
"""


@pytest.fixture(params=TIMED)
def run(request: pytest.FixtureRequest, tmp_path: Path, stranger: Any) -> Iterator[AfspmRun]:
    """The file also names a controller outside this run, which must receive nothing."""
    (tmp_path / "witness.py").write_text(WITNESS, encoding="utf-8")
    address = MAKERS[request.param].address.format(port=stranger.port)
    (tmp_path / "overlay.toml").write_text(OVERLAY.format(address=address), encoding="utf-8")
    files = (
        str(FILES / "experiment.toml"),
        str(MAKERS[request.param].emulated),
        str(tmp_path / "overlay.toml"),
    )
    options = ("--runs", str(tmp_path / "runs"), "--verbose", "--no-report", "--without", "metadata")
    one = AfspmRun("run", *files, *options, folder=tmp_path)
    yield one
    one.close()


def test_controller_killed_during_a_scan_is_a_malfunction_until_its_return(run: AfspmRun) -> None:
    run.wait_for("details .*scan 1 of 3 at")
    run.wait_for_next(" witness ", "state SCANNING")
    cleared_before = run.output.count("cleared device-malfunction")
    run.kill("controller")
    run.wait_for_next("ERROR lost contact with the controller: ")
    run.wait_for_next("translator flagged device-malfunction; details lost control")
    run.wait_up("controller", times=2)
    run.wait_for("translator cleared device-malfunction", count=cleared_before + 1)
    assert run.end() == 0, run.output
    run.wait_for(" microscope ", "the controller answers again")
    run.wait_for("controller was restarted once")
    run.wait_for(f"measured: {SCANS} scans")
    seen = run.witnessed()
    assert set(seen.values()) == {1}, run.output
    channels = {channel for channel, _, _ in seen}
    for channel in channels:
        assert len([key for key in seen if key[0] == channel]) == SCANS, run.output
