"""Plans with settings of their own, on the simulator and each emulated controller: each scan has those of its plan."""

from __future__ import annotations

from pathlib import Path

import pytest
from makers import MAKERS
from rotation import rotated
from tests.system.experiment.experiment_lab import Run

from afspm.model import names
from afspm.night.run import open_run

SIMULATOR = Path(__file__).parents[3] / "experiments" / "every_microscope" / "simulator.toml"
MICROSCOPES = {"simulator": SIMULATOR} | {name: maker.emulated for name, maker in MAKERS.items()}
WITHOUT_BIAS = ("nanosurf",)
STATED = {"a": {names.TIP_BIAS_VOLTAGE: "0.5 V", names.SCAN_SPEED: "1.5 um/s"}, "b": {names.TIP_BIAS_VOLTAGE: "-0.3 V"}}
SIZES_NM = {"a": 100, "b": 120, "plain": 140}
EACH = 3


def plans(microscope: str) -> str:
    lines = ['[scheduler]\ncomponent = true\nclass = "Scheduler"\n']
    for name, size_nm in SIZES_NM.items():
        stated = {
            one: value
            for one, value in STATED.get(name, {}).items()
            if microscope not in WITHOUT_BIAS or one != names.TIP_BIAS_VOLTAGE
        }
        given = ", ".join(f'{one} = "{value}"' for one, value in stated.items())
        lines.append(
            f'[{name}]\ncomponent = true\nclass = "ScanSeries"\nsize = ["{size_nm} nm", "{size_nm} nm"]\n'
            f'pixels = [16, 16]\nevery = "4 s"\nscans = {EACH}\nparameters = {{ {given} }}\n'
        )
    return "\n".join(lines)


@pytest.mark.slow
@pytest.mark.parametrize("microscope", rotated(list(MICROSCOPES), 2))
def test_plans_that_alternate_measure_with_their_own_settings(afspm_run: Run, tmp_path: Path, microscope: str) -> None:
    file = tmp_path / "plans.toml"
    file.write_text(plans(microscope), encoding="utf-8")
    one = afspm_run(str(file), str(MICROSCOPES[microscope]), "--runs", str(tmp_path / "runs"), where=tmp_path)
    one.end()
    found: dict[int, list[tuple[float | None, ...]]] = {}
    with open_run(one.folder) as run:
        for scan in run.scans:
            assert scan.region is not None
            begun = {setting.name: setting.constant for setting in scan.in_force}
            values = begun.get(names.TIP_BIAS_VOLTAGE), begun[names.SCAN_SPEED]
            found.setdefault(round(scan.region.size_m[0] * 1e9), []).append(values)
    assert {size: len(values) for size, values in found.items()} == dict.fromkeys(SIZES_NM.values(), EACH)
    ((base_v, base_speed),) = set(found[SIZES_NM["plain"]])
    has_bias = microscope not in WITHOUT_BIAS
    wanted = {"a": (0.5 if has_bias else None, 1.5e-6), "b": (-0.3 if has_bias else None, base_speed)}
    for name, values in wanted.items():
        for taken in found[SIZES_NM[name]]:
            assert taken == pytest.approx(values), name
    assert base_v not in (0.5, -0.3)
    assert not [line for line in one.lines if "CRITICAL" in line or "Traceback" in line]
