"""Nights with the default scanner and with a real one's statistics: `python -m benchmarks.scanner_nights [NAME …]`.

The paper's night with tip repair (eight hours), and the longest sample, a night on a sample that drifts (eighteen
hours), in real processes at 480 times the speed. A night takes two or three minutes on an idle computer, and a quarter
of an hour if it waits for a person. The figures come from the truth and from the record of verdicts; those of "stm-4k"
say what the default scanner hides. There are no targets.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from afspm.basics.plain_data import Plain, from_json
from afspm.night.bad_scans import BAD, last_scores
from afspm.night.run import open_run
from benchmarks.compare import ROOT
from benchmarks.crashes import CrashWatch

EXPERIMENTS = ROOT / "experiments"
SCANNERS = ("simulator", "stm-4k")
LONGEST_S = 900.0
"""Real time after that a night is ended: the last repair of a tip may have failed, and waits for a person."""
CORRECTED_S = 2.5 * 3600.0
"""Time after the start from that on drift is corrected, experiment time."""
SAME_SCAN_S = 0.5


def night(name: str, scanner: str, folder: Path) -> tuple[Path, bool]:
    """Run a sample, and return its run folder and whether it ended by itself."""
    files = [EXPERIMENTS / name / "experiment.toml"]
    overlay = EXPERIMENTS / name / f"{scanner}.toml"
    if overlay.exists():
        files.append(overlay)
    command = [sys.executable, "-m", "afspm", "run", *map(str, files), "--runs", str(folder / scanner)]
    watch = CrashWatch()
    with (
        (folder / f"{scanner}.log").open("w", encoding="utf-8") as log,
        subprocess.Popen(command, cwd=EXPERIMENTS, stdout=log, stderr=log) as process,
    ):
        try:
            process.wait(LONGEST_S)
            ended = True
        except subprocess.TimeoutExpired:
            end = [sys.executable, "-m", "afspm", "end", "--yes", str(folder / scanner / "latest")]
            subprocess.run(end, check=False, stdout=log, stderr=log)  # the night may just be ending by itself
            process.wait(LONGEST_S)
            ended = False
    if crashes := watch.in_logs(folder / scanner):
        raise RuntimeError(f"a process has crashed: {crashes}")
    return folder / scanner / "latest", ended


def truth(run: Path) -> list[Plain]:
    """Return the true events of a run, with their time after the start under "since_s"."""
    events = [from_json(line) for line in (run / "truth.jsonl").read_text(encoding="utf-8").splitlines()]
    return [{**event, "since_s": event["time_s"] - events[0]["time_s"]} for event in events]


def tip_repair(run: Path, *, ended: bool) -> Mapping[str, float]:
    """Return the figures of the night with tip repair."""
    events = truth(run)
    scans = [event for event in events if event["event"] == "scan"]
    treatments = [event for event in events if event["event"] in ("pulse", "crash")]
    reading = open_run(run)
    found = list(reading.verdicts())
    judged = last_scores([of_ns for of_ns, _ in found], found)
    sharp_but_bad = flawed_but_passed = 0
    for event in scans:
        score = next((one for ns, one in judged.items() if abs(ns / 1e9 - event["scan"]["end_s"]) < SAME_SCAN_S), None)
        flawed = bool(event["scan"]["tips"][-1]["flaws"])
        sharp_but_bad += score == BAD and not flawed
        flawed_but_passed += score is not None and score != BAD and flawed
    good = 0
    tip_is_sharp = True
    for event in events:
        if event["event"] in ("pulse", "crash"):
            good += tip_is_sharp
        if "tip" in event.get("truth", {}):
            tip_is_sharp = not event["truth"]["tip"]["flaws"]
    return {
        "hours until the last scan": scans[-1]["since_s"] / 3600.0,
        "ended by itself": float(ended),
        "scans": float(len(scans)),
        "treatments": float(len(treatments)),
        "treatments of a sharp tip": float(good),
        "sharp tip judged bad": float(sharp_but_bad),
        "flawed tip not judged bad": float(flawed_but_passed),
    }


def drift_night(run: Path, *, ended: bool) -> Mapping[str, float]:
    """Return the figures of the night on a sample that drifts; lengths in nm, on the sample."""
    scans = [event for event in truth(run) if event["event"] == "scan"]
    centers = np.array([[event["scan"]["under_start_m"], event["scan"]["under_end_m"]] for event in scans])
    off_nm = 1e9 * np.hypot(*(centers.mean(axis=1) - centers[0].mean(axis=0)).T)
    within_nm = 1e9 * np.hypot(*(centers[:, 1] - centers[:, 0]).T)
    late = np.array([event["since_s"] >= CORRECTED_S for event in scans])
    return {
        "ended by itself": float(ended),
        "scans": float(len(scans)),
        "off its place, rms nm": math.sqrt(np.mean(off_nm[late] ** 2)),
        "off its place, most nm": float(off_nm[late].max()),
        "moves within a scan, rms nm": math.sqrt(np.mean(within_nm[late] ** 2)),
    }


NIGHTS = {"tip_repair": tip_repair, "drift_night": drift_night}


def main(names: Sequence[str]) -> int:
    """Run the nights, and print the figures side by side."""
    results: dict[str, dict[str, Mapping[str, float]]] = {}
    for name in names or NIGHTS:
        figures = NIGHTS[name]
        print(f"{name:32} {SCANNERS[0]:>12} {SCANNERS[1]:>12} {'difference':>12}", flush=True)
        with tempfile.TemporaryDirectory(prefix="scanner-nights-") as folder:
            found = {}
            for scanner in SCANNERS:
                run, ended = night(name, scanner, Path(folder))
                found[scanner] = figures(run, ended=ended)
        default, real = (found[scanner] for scanner in SCANNERS)
        for figure, value in default.items():
            print(f"  {figure:30} {value:12.4g} {real[figure]:12.4g} {real[figure] - value:+12.4g}", flush=True)
        results[name] = found
    out = ROOT / "build" / "scanner_nights.json"
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(results, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
