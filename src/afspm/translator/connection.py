"""The connection to the controller, with retries after a loss."""

from __future__ import annotations

import logging
from collections.abc import Callable

from afspm.basics.clock import Clock
from afspm.basics.errors import AfspmError, ConfigError
from afspm.translator.controller_lock import ControllerTaken
from afspm.translator.driver_base import LOST, ControllerLost, ControllerSilent, DriverBase
from afspm.translator.emulated_controller import EmulatedController
from afspm.transport.process.failure import place_of

RETRY_S = 1.0  # real: a controller that was started again is found within a second (decision 0016)
_OFTEN_SILENT = 3  # attempts in turn that a port accepts and does not answer, before the error asks for a restart
_MOST_DOUBLED = 4
"""A port that stays silent is tried each `RETRY_S` · 2 ** 4 = 16 s at last."""
_STARTUP_S = 2.0
"""Real time in which a controller that starts together with its translator (an emulated one) may be missing: until then
connecting is retried every `_STARTUP_RETRY_S`, and nothing is logged."""
_STARTUP_RETRY_S = 0.1  # real time


class Connection:
    """The connection of a driver to its controller, with the decision which errors mean that the controller is lost.

    Args:
        controller: the emulator of this run, the only controller to connect to; None: the driver knows the
            address of its controller.
        on_lost: called to publish the loss.
        take: called with the `identity` of the connected driver. Raises ControllerTaken.

    Attributes:
        is_reached: True while the driver is connected.
        stands: True while the driver is connected, and its state is observed.
        why_lost: the reason of the last loss.
        ever_stood: True once `stands` has been True.
    """

    def __init__(
        self,
        driver: DriverBase,
        controller: EmulatedController | None,
        clock: Clock,
        log: logging.Logger,
        on_lost: Callable[[], None],
        take: Callable[[str], None] = lambda identity: None,
    ) -> None:
        self._driver = driver
        self._controller = controller
        self._clock = clock
        self._log = log
        self._on_lost, self._take = on_lost, take
        self.stands = self.is_reached = False
        self.why_lost = self._logged = ""
        self.ever_stood = self._loss_published = False
        self._retry_at_s = 0.0
        self._silent = 0  # connections in a row that were accepted, and in which a question was not answered
        self._began_s = clock.monotonic_s()

    def establish(self) -> bool:
        """Connect if the next attempt is due. Return True if the connection was made."""
        if self._clock.monotonic_s() < self._retry_at_s:
            return False
        self.reach()
        self.stands = self.ever_stood = True
        self._silent = 0
        if self._logged:
            self._logged = ""
            self._log.info("the controller answers again")
        return True

    def reach(self) -> None:
        """Connect at once, unless connected.

        Raises:
            an error in `LOST`, or another error of `Driver.connect`.
        """
        if self.is_reached:
            return
        if self._controller is None:
            self._driver.connect()
        else:
            self._controller.reach(self._driver)
        self._take(self._driver.identity)
        self.is_reached = True

    def reach_for_retract(self) -> None:
        """Connect as `reach`, and go on if connecting failed halfway, for lack of a folder of data for example.

        Raises:
            an error in `LOST`.
        """
        try:
            self.reach()
        except LOST:
            raise
        except Exception as error:  # broad: a driver may raise anything, and the tip may be reachable all the same
            self._log.warning("connecting failed, and retracting the tip is tried all the same: %s", error)

    def tell_lost(self) -> None:
        """Publish again that the state is unknown, unless the controller is reached: something else was published."""
        if not self.is_reached:
            self._on_lost()

    def require(self) -> None:
        """Raise ControllerLost unless `stands`."""
        if not self.stands:
            raise ControllerLost(f"the controller is lost, and connecting is retried: {self.why_lost}")

    def wait_s(self) -> float:
        """Return the real seconds until the next attempt to connect."""
        return max(0.0, self._retry_at_s - self._clock.monotonic_s())

    def guarded(self, do: Callable[[], None]) -> bool:
        """Call `do`. Return False after an error, which counts as a loss of the controller.

        Raises:
            ConfigError, ControllerTaken: the first connection can't succeed with these settings, or another run has it.
        """
        try:
            do()
            return True
        except (ConfigError, ControllerTaken) as error:
            if not self.ever_stood:
                raise
            self.lose(error)
        except (*LOST, AfspmError) as error:
            self.lose(error)
        except Exception as error:  # a driver may raise anything, and its translator must live on to retract the tip
            self._log.debug("reading the controller's state failed", exc_info=True)
            self.lose(error)
        return False

    def lose(self, error: Exception) -> None:
        """Record the loss; publish a loss once, and log each reason once."""
        now_s = self._clock.monotonic_s()
        starts = isinstance(error, LOST) and not self.ever_stood and now_s - self._began_s < _STARTUP_S
        self._silent = self._silent + 1 if isinstance(error, ControllerSilent) else 0
        # others report of a real controller that a port is silent until the restart: each attempt may prolong it
        doubled = min(max(0, self._silent - _OFTEN_SILENT), _MOST_DOUBLED)
        self._retry_at_s = now_s + (_STARTUP_RETRY_S if starts else RETRY_S * 2**doubled)
        if self._silent == _OFTEN_SILENT:
            text = "a port accepts connections and answers nothing: it may be wedged, or a dialog waits; restart %s"
            self._log.error(text, type(self._driver).__name__)
        stood, self.stands, self.is_reached = self.stands, False, False
        self.why_lost = _reason(error)
        if not starts and (stood or self.why_lost != self._logged):
            self._logged = self.why_lost
            if self.ever_stood:
                self._log.error("lost contact with the controller: %s; retrying", self._logged)
            else:  # it may be started later, by a person or by afspm
                self._log.warning("no contact with the controller yet: %s; retrying", self._logged)
        if stood or not self._loss_published:
            self._loss_published = True
            self._on_lost()


def _reason(error: Exception) -> str:
    if isinstance(error, AfspmError | OSError):
        return str(error)
    return f"{type(error).__name__}: {error} ({place_of(error)})"  # a fault of the driver, found by its line
