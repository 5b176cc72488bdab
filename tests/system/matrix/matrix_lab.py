"""The matrix of components and instruments: the jobs, their files, and the recorded outcomes.

A job is an experiment file without a microscope. A maker's own file, or the simulator's, is laid over it, and a third
one with what happens in the simulated world (drift, a change of the tip) or is in the unit of one controller (gains).
`make test-matrix` runs all of them, and writes `matrix.toml` again.
"""

from __future__ import annotations

import re
import shutil
import tomllib
from collections.abc import Sequence
from pathlib import Path

from makers import MAKERS
from tests.system.matrix.proofs import PROOFS

from afspm.basics import entry_points
from afspm.experiment import load

HERE = Path(__file__).parent
RECORD = HERE / "matrix.toml"
JOBS = HERE / "jobs"
EXPERIMENTS = HERE.parents[2] / "experiments"
OUTSIDE = {"nion": "Nion"}
"""Instruments of other distributions, by the names of their drivers: their cells run where the driver is installed."""
SECOND_FILES = (
    {"simulator": EXPERIMENTS / "every_microscope" / "simulator.toml"}
    | {name: maker.emulated for name, maker in MAKERS.items()}
    | {
        name: folder / "simulated.toml"
        for name, driver in OUTSIDE.items()
        if (folder := entry_points.folder(entry_points.DRIVERS, driver)) is not None
    }
)
IMPOSSIBLE = "not possible: "
ELSEWHERE = {
    "Instrument": "speaks to another instrument, not to the microscope",
    "Notifier": "speaks to a person, not to the microscope",
    "SweepAt": "needs an instrument beside it: tests/system/experiment/test_sweep_at_runs.py",
    "TraceReplay": "stands in for a controller",
}
"""Components that have no job here, and why."""
CELLS = [(job, instrument) for job in PROOFS for instrument in SECOND_FILES]


_GAINS = {
    "asylum": (0.01, 1000.0),
    "gxsm": (0.1, 200.0),
    "nanonis": (1e-10, 1e-5),
    "nanosurf": (1.0, 100_000.0),
    "park": (0.001, 100.0),
    "simulator": (1.0, 100_000.0),
}
"""Bounds of the integral gain, each in the unit of its controller."""


def _happens(job: str, instrument: str) -> str:
    # what happens in the world of a job, and what is in a maker's own unit, as a third file
    if instrument in OUTSIDE:
        return 'drift = ["0.1 nm/s", "-0.06 nm/s"]' if job == "drift" else ""
    if job == "drift":
        return "drift = { velocity_m_per_s = [0.1e-9, -0.06e-9, 0.0] }"
    if job == "potential" and instrument in ("simulator", "gxsm", "nanonis"):  # the others have no tunnelling sensor
        spots = 'property_map = { kind = "smooth", quantity = "contact_potential" }'
        return f'feedback = {{ mode = "current", setpoint = 50e-12, qplus = true }}\n{spots}'
    if job == "feedback" and instrument == "gxsm":
        return 'feedback = { mode = "current" }'  # its mixer's setpoint is a current
    of_tip = {
        "judge": '{ in_scans = [[5, "double"]] }',
        "lines": '{ in_scans = [[6.4, "double"]] }',
        "repair": '{ in_scans = [[5, "double"]], pulse_cures = 1.0, pulse_worsens = 0.0 }',
    }
    return f"tip_changes = {of_tip[job]}" if job in of_tip else ""


def _own_units(job: str, instrument: str) -> str:
    if job == "lines" and instrument in ("nanonis", "nanosurf"):
        # a clock that waits for lines lets Nanonis end a scan late; of a real Studio no number of the buffer is known
        return f"[microscope]\n{'image_buffer = 4410' if instrument == 'nanosurf' else 'reply_timeout_s = 60.0'}\n"
    if (job, instrument) == ("repair", "gxsm"):
        return "[clock]\nspeed = 2.0\n"  # a pulse is a bias that is in force for less than a second
    if job != "feedback" or instrument not in _GAINS:
        return ""
    lowest, highest = _GAINS[instrument]
    tuner = f"[tuner]\nlowest_gain = {lowest}\nhighest_gain = {highest}\n"
    if instrument != "gxsm":
        return tuner
    decay = 'sensitivity = "50 pm"\n'  # of a current, for a factor e
    # a tunnelling tip follows the flanks of particles at this speed, as none does at 4 um/s
    return f'{tuner}{decay}[analysis]\n{decay}[series]\nparameters = {{ scan-speed = "0.2 um/s" }}\n'


def files(folder: Path, job: str, instrument: str) -> tuple[Path, ...]:
    """Return the files of a cell: the job, the maker's, and what happens in the simulated world.

    The job is copied into the folder, with the modules that it names.
    """
    shutil.copytree(JOBS, folder)
    shutil.copy(EXPERIMENTS / "agent" / "scripted.py", folder)
    world = "controller" if instrument in MAKERS else "microscope"
    happens = _happens(job, instrument)
    third = folder / "world.toml"
    third.write_text((f"[{world}]\n{happens}\n" if happens else "") + _own_units(job, instrument), encoding="utf-8")
    return folder / f"{job}.toml", SECOND_FILES[instrument], third


def refusal(of_cell: Sequence[Path]) -> str:
    """Return why `afspm check` refuses the files of a cell; empty if it does not."""
    errors = [one.what for one in load(*of_cell).check() if one.is_error]
    return re.sub(r", which \[microscope\] .*", "", errors[-1]) if errors else ""


def recorded() -> dict[str, dict[str, dict[str, str]]]:
    """Return the recorded outcomes, by job, component and instrument."""
    found: dict[str, dict[str, dict[str, str]]] = tomllib.loads(RECORD.read_text(encoding="utf-8"))
    return found
