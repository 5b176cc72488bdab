"""`sample-bias` through real processes: the sign, the limit and the second electrode, at the simulator and makers."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import h5py
import pytest
from afspm_process import AFSPM
from deadlines import DEADLINE_S
from makers import MAKERS

import afspm

FILES = Path(__file__).parents[3] / "experiments" / "every_microscope"
OVERLAY = """
[details]
component = false

[metadata]
component = false

[recorder]
component = true
class = "Recorder"

[asker]
component = true
class = "asker.Asker"
"""
ASKER = '''
"""Sets the bias by both names, and writes down each answer."""

import json

from afspm import Component
from afspm.basics import RequestError


class Asker(Component):
    def run(self):
        answers = {}

        def ask(label, call):
            try:
                answers[label] = call()
            except RequestError as error:
                answers[label] = str(error)

        scope = self.scope
        with scope.control():
            ask("set", lambda: scope.set("sample-bias", "0.5 V"))
            ask("panel", lambda: scope.get("tip-bias-voltage"))
            ask("too far", lambda: scope.set("sample-bias", "1.5 V"))
            ask("the other way", lambda: scope.set("sample-bias", "-1.5 V"))
            ask("read", lambda: scope.get("sample-bias"))
            with scope.sweep({"sample-bias": ["0.2 V", "0.4 V"]}, shape=(16, 16)) as points:
                ask("swept", lambda: [point.values for point in points])
            ask("set back", lambda: scope.get("tip-bias-voltage"))
            if SECOND:
                scope.set("x-sample-bias", "1 V")
                ask("with a second", lambda: scope.set("sample-bias", "0.1 V"))
                ask("read with a second", lambda: scope.get("sample-bias"))
                ask("panel with a second", lambda: scope.set("tip-bias-voltage", "0.1 V"))
        (self.run_dir / "answers.json").write_text(json.dumps(answers))
        scope.end_experiment()
'''


def answers_at(microscope: str, folder: Path, more: str, *, second: bool = False) -> tuple[dict[str, Any], Path]:
    overlay = folder / "overlay.toml"
    overlay.write_text(OVERLAY + more, encoding="utf-8")
    (folder / "asker.py").write_text(ASKER.replace("SECOND", repr(second)), encoding="utf-8")
    second_file = MAKERS[microscope].emulated if microscope in MAKERS else FILES / "simulator.toml"
    files = [str(FILES / "experiment.toml"), str(second_file), str(overlay)]
    done = subprocess.run(
        [*AFSPM, "run", *files, "--runs", str(folder / "runs"), "--no-report"],
        capture_output=True,
        encoding="utf-8",
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (file,) = (folder / "runs").glob("*-*/answers.json")
    return json.loads(file.read_text(encoding="utf-8")), file.parent


@pytest.mark.parametrize(
    ("microscope", "of", "settings", "limits"),
    [
        ("simulator", "sample", "", "[limits.sample-bias]"),
        ("nanonis", "sample", 'bias_reference = "sample"', "[limits.sample-bias]"),
        ("nanonis", "tip", 'bias_reference = "tip"', "[limits.sample-bias]"),
        ("park", "tip", "", "[limits.tip-bias-voltage]"),
        ("asylum", "tip", "", "[limits.tip-bias-voltage]"),
    ],
)
def test_bias_of_the_sample_is_set_read_swept_and_limited(
    microscope: str, of: str, settings: str, limits: str, tmp_path: Path
) -> None:
    second, sign = microscope in ("park", "asylum"), 1.0 if of == "sample" else -1.0
    # the limit counts as written: on the alias by the sample, on the panel by its own sign
    ends = 'min = "-2 V"\nmax = "1 V"\n' if "sample" in limits or sign > 0 else 'min = "-1 V"\nmax = "2 V"\n'
    more = f"[microscope]\n{settings}\n{limits}\n{ends}"
    found, folder = answers_at(microscope, tmp_path, more, second=second)
    assert found["set"] == pytest.approx(0.5)
    assert found["panel"] == pytest.approx(sign * 0.5)
    assert f"tip-bias-voltage = {'-' if sign < 0 else ''}1.5 V is" in found["too far"]
    assert found["the other way"] == found["read"] == pytest.approx(-1.5)
    assert [point["sample-bias"] for point in found["swept"]] == [0.2, 0.4]
    assert found["set back"] == pytest.approx(sign * -1.5)
    if second:
        for label in ("with a second", "read with a second"):
            assert "x-sample-bias reads 1 V: set it to 0 V" in found[label]
        assert found["panel with a second"] == pytest.approx(0.1)
    with afspm.open_run(folder) as run:
        rows = run.scans.to_pandas()
        captions = [row.caption() for row in run.scans]
        written = [h5py.File(folder / row.file)["entry/afspm/in_force/bias_reference"][()] for row in run.scans]
    assert written == [of.encode()] * 2
    assert [*rows["bias-reference"]] == [of, of]
    assert list(rows["tip-bias-voltage [V]"]) == pytest.approx([sign * 0.2, sign * 0.4])
    assert captions[0].startswith(f"V({of}) = {'-' if sign < 0 else ''}200 mV")


def test_without_a_reference_the_emulated_nanonis_refuses_it(tmp_path: Path) -> None:
    found, folder = answers_at("nanonis", tmp_path, "")
    for label in ("set", "read", "swept"):
        assert 'bias_reference = "sample" or "tip"' in found[label]
    assert found["set back"] == found["panel"]
    with afspm.open_run(folder) as run:
        assert "bias-reference" not in run.scans.to_pandas()
