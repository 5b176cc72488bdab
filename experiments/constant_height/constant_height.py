"""A stack of scans at constant heights, each without feedback, of a tip that was checked before."""

import numpy as np
from matplotlib.figure import Figure

from afspm import Component, Region
from afspm.basics import Current, Length, Voltage, scale
from afspm.model import names


class ConstantHeight(Component):
    """Checks the tip by the noise of its current, and scans a region at each height, from the highest to the lowest."""

    needs_actions = (names.START_SCAN, names.HOLD_Z)
    needs_parameters = (names.CURRENT,)

    def __init__(
        self,
        size: Length,
        heights: list[Length],
        bias: Voltage,
        abort_current: Current,
        pixels: int = 96,
        noisy: float = 0.2,
    ):
        self.region, self.shape = Region((0.0, 0.0), (size, size)), (pixels, pixels)
        self.heights, self.bias, self.abort_current, self.noisy = (
            sorted(heights, reverse=True),
            bias,
            abort_current,
            noisy,
        )

    def run(self):
        scope, stack = self.scope, []
        with scope.control():
            scope.scan(self.region, shape=self.shape, key="with-feedback")  # the tip must be here, and at rest
            self.check_tip()
            with scope.hold_z(self.heights[0], bias=self.bias, abort_current=self.abort_current) as held:
                for number, height in enumerate(self.heights):
                    held.move(height)
                    self.log.info("at %+.0f pm the current is %.3g pA", 1e12 * height, 1e12 * held.read(names.CURRENT))
                    scans = scope.scan(self.region, shape=self.shape, key=f"height-{number}")
                    held.check()
                    stack.append(scans["current"])
        self.draw(stack)
        scope.end_experiment()

    def check_tip(self):
        """Raise an error unless the feedback holds the current of the setpoint steadily."""
        setpoint = self.scope.get(names.ZCTRL_SETPOINT)
        currents = np.array([self.scope.read(names.CURRENT) for _ in range(10)])
        scatter = float(np.abs(currents - setpoint).max() / setpoint)
        self.log.info("tip check: the current differs from its setpoint by at most %.0f %%", 100 * scatter)
        if scatter > self.noisy:
            raise RuntimeError(f"the tip is not stable: its current differs by {scatter:.0%} from the setpoint")

    def draw(self, stack):
        columns = min(4, len(stack))
        rows = -(-len(stack) // columns)
        figure = Figure(figsize=(2.9 * columns, 3.0 * rows), layout="constrained")
        figure.suptitle(self.name + ", SIMULATED" * self.simulated)
        size_nm = 1e9 * self.region.size_m[0]
        panels = figure.subplots(rows, columns, squeeze=False).flat
        for axes, height, scan in zip(panels, self.heights, stack, strict=False):  # the last row may have free panels
            low, high = np.percentile(scan.values, [1, 99])
            factor, unit = scale(max(abs(low), abs(high)), "A")
            drawn = axes.imshow(
                factor * scan.values,
                origin="lower",
                extent=(0, size_nm, 0, size_nm),
                vmin=factor * low,
                vmax=factor * high,
            )
            axes.set(title=f"{1e12 * height:+.0f} pm", xlabel="x (nm)", ylabel="y (nm)")
            figure.colorbar(drawn, label=f"current ({unit})", shrink=0.8)
        for free in panels:
            free.set_axis_off()
        figure.savefig(self.run_dir / "stack.png", dpi=160)
