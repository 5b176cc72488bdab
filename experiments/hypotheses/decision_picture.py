"""The picture of a decision: the curves on the difference of both hypotheses, and both over the distance."""

import numpy as np
from matplotlib.figure import Figure
from spots import difference, spot


def draw(path, title, size_nm, places, gaps, fits, better):
    """Draw the numbered places of the curves, and the gaps over the distance from the centre of the better fit."""
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    figure.suptitle(title)
    plan, profile = figure.subplots(1, 2)
    axis, half_nm = np.linspace(-0.5, 0.5, 101), size_nm / 2
    everywhere = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    values = 1e3 * difference(fits, everywhere).reshape(101, 101)
    drawn = plan.imshow(values, origin="lower", cmap="gray", extent=(-half_nm, half_nm, -half_nm, half_nm))
    figure.colorbar(drawn, label="difference of the hypotheses (meV)")
    for number, place in enumerate(size_nm * places, 1):
        plan.annotate(str(number), place, color="tab:orange", ha="center", va="center")
    margin = 1.06 * half_nm  # the first curves are on the border of the region
    plan.set(xlabel="x (nm)", ylabel="y (nm)", xlim=(-margin, margin), ylim=(-margin, margin))
    distance = np.linspace(0.0, np.hypot(*(places - fits[better][2:4]).T).max(), 300)
    for name, (ground, change, _, _, half_width) in fits.items():
        along = np.stack([distance, np.zeros(300)], axis=1)
        profile.plot(size_nm * distance, spot(name, along, ground, change, 0.0, 0.0, half_width), label=name)
    profile.plot(size_nm * np.hypot(*(places - fits[better][2:4]).T), gaps, "k.", label="measured")
    profile.set(xlabel="distance from the centre (nm)", ylabel="gap (eV)")
    profile.legend()
    figure.savefig(path, dpi=160)
