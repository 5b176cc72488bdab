"""`ScanDrawing`: the picture of a simulated scan, worked out while the scan lasts."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, wait
from threading import Thread

from afspm.model import names
from afspm.simulation import SimulatedScan, World
from afspm.simulation.measuring import Adjustment
from afspm.translator.parameters import ParameterTable, Value
from afspm.translator.setting_groups import feedback, frame
from afspm.translator.state import Kept


class ScanDrawing:
    """Works one scan out beside everything else, so that nothing waits for it.

    Args:
        wake: called, from another thread, when a scan is worked out.
    """

    def __init__(self, world: World, table: ParameterTable, wake: Callable[[], None]) -> None:
        self._world = world
        self._table = table
        self._wake = wake
        self._scan: Future[SimulatedScan] | None = None

    @property
    def is_going_on(self) -> bool:
        """True while a scan is being worked out: it lasts until that is done, however fast time is."""
        return self._scan is not None and not self._scan.done()

    def begin(self, doing: Kept) -> None:
        """Begin to work out the scan that these facts tell: its start, its values, and what was set meanwhile."""
        future: Future[SimulatedScan] = Future()

        def work() -> None:
            try:
                future.set_result(self._draw(doing))
            except BaseException as error:
                future.set_exception(error)
            self._wake()

        # not an executor's thread: those are waited for when the process ends
        Thread(target=work, daemon=True, name="simulated scan").start()
        self._scan = future

    def wait(self) -> SimulatedScan | None:
        """Return the scan once it is worked out; None if there is none."""
        return None if self._scan is None else self._scan.result()

    def end(self) -> None:
        """Forget the scan; nothing works on the world any more."""
        if self._scan is not None:
            wait([self._scan])
        self._scan = None

    def _draw(self, doing: Kept) -> SimulatedScan:
        values = in_si(doing["values"], self._table)
        region, shape = frame(values)
        return self._world.scan(
            region,
            shape,
            line_s(values, region.size_m[0]),
            doing["start_s"],
            feedback(values),
            float(values[names.TIP_BIAS_VOLTAGE]),
            direction=str(values[names.SCAN_DIRECTION]),
            slope=(float(values[names.SAMPLE_SLOPE_X]), float(values[names.SAMPLE_SLOPE_Y])),
            adjusted=self._adjustments(doing),
        )

    def _adjustments(self, doing: Kept) -> list[Adjustment]:
        values, found = dict(doing["values"]), []
        for change in doing.get("adjusted", ()):
            values.update(change["values"])
            now = in_si(values, self._table)
            found.append(Adjustment(change["t_s"], feedback(now), float(now[names.TIP_BIAS_VOLTAGE])))
        return found


def in_si(values: dict[str, Value], table: ParameterTable) -> dict[str, Value]:
    """Return the values of a table's parameters, of the units of the instrument, in SI units."""
    return {name: table[name].from_vendor(value) for name, value in values.items() if name in table}


def line_s(values: dict[str, Value], width_m: float) -> float:
    """Return how long a line takes, there and back."""
    return 2.0 * width_m / float(values[names.SCAN_SPEED])
