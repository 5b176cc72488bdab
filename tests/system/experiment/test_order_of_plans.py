"""Plans that begin after others, while processes are killed and the run is resumed."""

from __future__ import annotations

from pathlib import Path

import systems
from tests.system.experiment.experiment_lab import AfspmRun, Run

import afspm

SAMPLE = Path(__file__).parents[3] / "experiments" / "three_spots" / "experiment.toml"
SLOW = "[clock]\nspeed = 4.0\n" + "".join(f"[spot_{one}]\ncounts = [2, 2]\n" for one in "abc")
SPOTS = ["spot_a"] * 4 + ["spot_b"] * 4 + ["spot_c"] * 4


def begun(run: Run, folder: Path) -> AfspmRun:
    overlay = folder / "slow.toml"
    overlay.write_text(SLOW, encoding="utf-8")
    return run(str(SAMPLE), str(overlay), "--runs", str(folder / "runs"))


def holders(one: AfspmRun) -> list[str | None]:
    with afspm.open_run(one.folder) as record:
        return [row.holder for row in record.spectra]


def test_plans_keep_their_order_whichever_is_killed(afspm_run: Run, tmp_path: Path) -> None:
    one = begun(afspm_run, tmp_path)
    one.wait_for("spot_b .*begins when spot_a is done")
    one.kill("spot_b")
    one.wait_for("spectrum 2 of 4")
    one.kill("spot_a")
    one.wait_for("spot_a .*done")
    one.wait_for("spot_b .*spectrum 2 of 4")
    one.kill("scheduler")
    one.kill("spot_c")
    assert one.end() == 0, one.output
    assert holders(one) == SPOTS, one.output


def test_resumed_run_begins_no_plan_before_its_turn(afspm_run: Run, tmp_path: Path) -> None:
    one = begun(afspm_run, tmp_path)
    one.wait_for("spot_a .*spectrum 2 of 4")
    systems.interrupt(one.process)
    one.end()
    again = afspm_run("--resume", str(one.folder), "--no-report")
    assert again.end() == 0, again.output
    assert holders(one) == SPOTS, again.output


ROUGH = """
from afspm import Component


class Rough(Component):
    def __init__(self, **settings): ...

    def run(self):
        raise ValueError("too rough")
"""


def test_plan_begins_after_another_was_given_up(afspm_run: Run, tmp_path: Path) -> None:
    (tmp_path / "rough.py").write_text(ROUGH, encoding="utf-8")
    overlay = tmp_path / "rough.toml"
    slow = SLOW.replace("4.0", "60.0").replace("[spot_a]", '[spot_a]\nclass = "rough.Rough"')
    overlay.write_text(slow, encoding="utf-8")
    one = afspm_run(str(SAMPLE), str(overlay), "--runs", str(tmp_path / "runs"))
    assert one.end() == 0, one.output
    assert "spot_a was given up; beginning all the same" in one.output
    assert holders(one) == SPOTS[4:], one.output
