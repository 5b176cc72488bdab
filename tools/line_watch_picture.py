"""Draws docs/pictures/line-watch.png: a scan whose tip changes, and the evidence that its lines give."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from afspm.model import Region
from afspm.plugins.line_watch.line_judge import FITTED, AlarmLevel, Kind, LineJudge
from afspm.plugins.line_watch.registration import levelled
from afspm.simulation import World

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "pictures" / "line-watch.png"
REGION, ROWS, LINE_S, PERIOD_S, CHANGED_ROW, GOOD = Region((0.0, 0.0), (1e-6, 1e-6)), 128, 2.0, 300.0, 50, 4


def main() -> None:
    world = World.from_settings(
        {
            "surface": {"kind": "particles"},
            "drift": {"velocity_m_per_s": [0.03e-9, 0.01e-9, 0.0]},
            "tip_changes": {"schedule": [[GOOD * PERIOD_S + CHANGED_ROW * LINE_S, "double"]]},
        },
        7,
        0.0,
    )
    judge, kind = LineJudge(), Kind.of(REGION, (ROWS, ROWS), "")
    pictures, curves, alarm = [], {}, None
    for number in range(GOOD + 1):
        at_s = number * PERIOD_S
        channels = world.scan(REGION, (ROWS, ROWS), LINE_S, at_s).channels()
        picture = [channels[name][1] for name in ("Height", "Height Retrace")]
        running = judge.begin(REGION, kind, at_s, channels=2)
        if running is not None:
            curve = curves[number] = []
            for row in range(ROWS):
                found = running.add(row, [values[row] for values in picture])
                curve.append(running.evidence)
                if found is not None and found.level is AlarmLevel.STOP:
                    alarm = found
                    break
        pictures.append(picture[0])
        judge.learn(picture, REGION, kind, at_s + ROWS * LINE_S)
    if alarm is None:
        raise SystemExit("the change was not seen")
    before, stopped = (levelled(values) * 1e9 for values in pictures[-2:])
    low, high = np.percentile(before, (1, 99))
    stopped[alarm.row + 1 :] = np.nan
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained", width_ratios=(1, 1, 1.15))
    for axis, values, title in zip(
        axes, (before, stopped), ("earlier scan of the place", "running scan, stopped"), strict=False
    ):
        drawn = axis.imshow(values, origin="lower", vmin=low, vmax=high, extent=(0, 1, 0, 1), cmap="afmhot")
        axis.set(title=title, xlabel="x / µm", facecolor="0.85")
    axes[0].set_ylabel("y / µm")
    figure.colorbar(drawn, ax=axes[1], label="height / nm")
    axes[1].axhline((alarm.since_row + 0.5) / ROWS, color="w", linestyle="--")
    axes[1].text(0.98, (alarm.row + 4) / ROWS, f"tip changed, row {alarm.since_row}", ha="right", va="bottom")
    axes[1].text(0.5, 0.75, "saved", ha="center", color="0.4")
    for number, curve in curves.items():
        axes[2].plot(np.arange(len(curve)), curve, color="tab:red" if number == GOOD else "tab:blue")
    axes[2].text(CHANGED_ROW + 6, 0.8, "scan with the change", color="tab:red")
    axes[2].text(ROWS, 0.4, "good scan", ha="right", color="tab:blue")
    axes[2].axhline(1.0, color="k", linewidth=0.8)
    axes[2].axhline(FITTED.look, color="k", linewidth=0.8, linestyle=":")
    axes[2].text(ROWS, 1.02, "stop", ha="right", va="bottom")
    axes[2].text(ROWS, FITTED.look + 0.02, "look", ha="right", va="bottom")
    axes[2].axvline(CHANGED_ROW, color="0.6", linewidth=0.8)
    axes[2].text(CHANGED_ROW + 3, 1.2, "true change", color="0.4")
    axes[2].set(xlabel="row", ylabel="evidence / threshold", xlim=(0, ROWS), ylim=(0, 1.3), title="evidence by row")
    figure.suptitle("SIMULATED", x=0.01, ha="left", fontsize=8, color="0.4")
    figure.savefig(PICTURE, dpi=110)


if __name__ == "__main__":
    main()
