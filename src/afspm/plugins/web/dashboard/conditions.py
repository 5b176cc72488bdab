"""Conditions of scans: parameters read at the start of a scan, because no message contains them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from concurrent.futures import Future

from afspm.model import names
from afspm.night import RunningScan
from afspm.plugins.web.dashboard.actions import Action, ActionResult
from afspm.plugins.web.watch import Watch

LABELS = {names.TIP_BIAS_VOLTAGE: "Bias", names.SCAN_SPEED: "Speed", names.ZCTRL_SETPOINT: "Setpoint"}
KEPT = 2_000


class Conditions:
    """A reader of a few parameters at the start of each scan, one read at a time.

    The conditions of a scan that begins during a read are read after that read, if the scan is still running.

    Args:
        ask: carries out an action in the name of the page, without waiting.
    """

    def __init__(self, watch: Watch, ask: Callable[[Action], Future[ActionResult]]) -> None:
        self._watch = watch
        self._ask = ask
        self._seen: RunningScan | None = None
        self._asking = False
        self._read: OrderedDict[int, Mapping[str, str]] = OrderedDict()
        watch.on_change(self._look)

    def at(self, began_ns: int | None) -> Mapping[str, str]:
        """Return labels and values for the scan that began at `began_ns`; empty if the parameters were not read."""
        return {} if began_ns is None else self._read.get(began_ns, {})

    def _look(self) -> None:
        # called with the watch's lock held
        running = self._watch.overview.running
        if running is None or running is self._seen or running.began_ns is None or self._asking:
            return
        self._seen, self._asking = running, True
        began_ns = running.began_ns
        asked = self._ask(lambda actions: actions.read(tuple(LABELS)))
        asked.add_done_callback(lambda done: self._keep(began_ns, done))

    def _keep(self, began_ns: int, done: Future[ActionResult]) -> None:
        self._asking = False
        if done.cancelled() or done.exception() is not None:
            return  # the dashboard ends
        values = done.result().each
        self._read[began_ns] = {LABELS[name]: one.text for name, one in values.items() if one.ok}
        while len(self._read) > KEPT:
            self._read.popitem(last=False)
