"""A controller that is lost is tried again, the less often the longer it accepts connections and stays silent."""

from __future__ import annotations

import logging
from typing import Any, cast

from afspm.basics.clock import ExperimentClock
from afspm.translator.connection import Connection
from afspm.translator.driver_base import ControllerLost, ControllerSilent


def test_port_that_is_silent_all_night_is_tried_every_16_s() -> None:
    clock = ExperimentClock.starting_now()
    connection = Connection(cast("Any", object()), None, clock, logging.getLogger("test"), lambda: None)
    connection.ever_stood = True
    for _ in range(2000):
        connection.lose(ControllerSilent("no answer"))
    assert 8.0 < connection.wait_s() <= 16.0
    connection.lose(ControllerLost("refused"))
    assert connection.wait_s() <= 1.0
