"""A held z that a person ends by MANUAL, on the bench: the holder learns of it."""

from __future__ import annotations

import pytest

from afspm import Component
from afspm.basics.errors import ControlLost
from afspm.model import ControlMode
from afspm.testing import Bench

STM = {"feedback": {"mode": "current", "setpoint": 1e-10}, "surface": "lattice"}


class Holder(Component):
    """Hold z for a minute without a request, then end the block as usual."""

    def run(self) -> None:
        ended = "without an error"
        try:
            with self.scope.hold_z(0.0):
                self.scope.sleep(60.0)
        except ControlLost as lost:
            ended = str(lost)
        raise SystemError(ended)


# tip T6
@pytest.mark.parametrize("again_s", [30.0, 1e4], ids=["given back", "kept"])
def test_hold_that_manual_ends_is_control_lost_at_the_end_of_the_block(again_s: float) -> None:
    bench = Bench(Holder(), microscope=STM)
    bench.at(20.0, bench.set_mode, ControlMode.MANUAL)
    bench.at(again_s, bench.set_mode, ControlMode.AUTOMATED)
    with pytest.raises(SystemError, match="control was lost while z was held: the mode is MANUAL"):
        bench.run(until="5 min")


def test_hold_that_control_outlives_ends_without_an_error() -> None:
    with pytest.raises(SystemError, match="without an error"):
        Bench(Holder(), microscope=STM).run(until="5 min")
