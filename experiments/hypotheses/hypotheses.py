"""Takes curves where two hypotheses differ most, until the odds of one of them are clear: spots.py has both."""

import json

import numpy as np
from decision_picture import draw
from spots import difference, judged

from afspm import Component
from afspm.basics import InvalidValue, Length
from afspm.plugins.adaptive.quantities import gap_ev


def lattice(count):
    """Return count x count places over the region."""
    axis = np.linspace(-0.5, 0.5, count)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


class Hypotheses(Component):
    """Takes first x first curves, then one after the other where the fits of both hypotheses differ most."""

    def __init__(self, size: Length = 1e-6, first: int = 4, probability: float = 0.99, most: int = 60):
        self.size, self.first, self.probability, self.most = size, first, probability, most

    def run(self):
        wanted, candidates = lattice(self.first), lattice(25)
        places, gaps, curves = [], [], 0
        while True:
            for x, y in wanted:
                curves += 1
                at = (self.size * float(x), self.size * float(y))
                curve = self.scope.spectrum(at, kind="IV", key=f"curve-{curves}")
                try:
                    gaps.append(gap_ev(curve))
                    places.append((x, y))
                except InvalidValue as unclear:
                    self.log.info("curve %d is left out: %s", curves, unclear.what)
                    candidates = candidates[np.hypot(*(candidates - (x, y)).T) > 1e-9]
            better, probability, fits = judged(np.array(places), np.array(gaps))
            self.log.info("%d curves: %s, with a probability of %.3f", len(gaps), better, probability)
            if probability >= self.probability or curves >= self.most:
                break
            wanted = candidates[[difference(fits, candidates).argmax()]]
        ground, change, x, y, half_width = map(float, fits[better])
        decision = {
            "decision": better if probability >= self.probability else "undecided", "probability": probability,
            "spectra": len(gaps), "ground_ev": ground, "change_ev": change,
            "center_m": [x * self.size, y * self.size], "half_width_m": abs(half_width) * self.size,
        }  # fmt: skip
        (self.run_dir / "decision.json").write_text(json.dumps(decision, indent=2), encoding="utf-8")
        title = f"{decision['decision']}, probability {probability:.3f}" + ", SIMULATED" * self.simulated
        draw(self.run_dir / "decision.png", title, 1e9 * self.size, np.array(places), gaps, fits, better)
        self.scope.end_experiment()
