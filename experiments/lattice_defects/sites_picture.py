"""The picture of classified sites: the defects and the measured atom in the scan, and the curves."""

import numpy as np
from matplotlib.figure import Figure

from afspm.basics import scale

COLOURS = {"vacancy": "tab:blue", "atom": "tab:green", "adatom": "tab:red"}


def draw(path, title, size_nm, heights, xy_nm, kinds, curves):
    """Draw the sites that are no common atoms, and the curve of each measured site, by its number."""
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    figure.suptitle(title)
    plan, currents = figure.subplots(1, 2)
    half_nm = size_nm / 2
    drawn = plan.imshow(1e12 * heights, origin="lower", cmap="gray", extent=(-half_nm, half_nm, -half_nm, half_nm))
    figure.colorbar(drawn, label="height (pm)")
    for kind, colour in COLOURS.items():
        shown = [site for site in np.flatnonzero(kinds == kind) if kind != "atom" or site in curves]
        plan.plot(xy_nm[0][shown], xy_nm[1][shown], "o", fillstyle="none", color=colour, label=kind)
    plan.set(xlabel="x (nm)", ylabel="y (nm)")
    for number, (site, curve) in enumerate(curves.items()):
        factor, unit = scale(np.abs(curve.values[:, 1]).max(), curve.units[1])
        wide = 4.0 - 1.3 * number  # curves that agree stay visible
        bias, current = curve.values[:, 0], factor * curve.values[:, 1]
        currents.plot(bias, current, color=COLOURS[kinds[site]], label=kinds[site], linewidth=wide)
        currents.set(xlabel=f"{curve.names[0]} ({curve.units[0]})", ylabel=f"{curve.names[1]} ({unit})")
    currents.legend()
    figure.savefig(path, dpi=160)
