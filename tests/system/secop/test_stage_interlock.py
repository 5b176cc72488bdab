"""A stage of another instrument that moves only while the tip is withdrawn, by a rule that names the act."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S
from tests.plugins.secop.test_secop_server_sample import loaded
from tests.system.secop.test_lock_in import EXPERIMENT, measured, running

import afspm
from afspm.basics.errors import Refused

STAGE = """parameters = { "lab.stage-x" = "stage" }

[limits]
forbid = ["changes(lab.stage-x) and x-engaged", "changes(x-engage) and lab.stage-x.busy"]
"""


class Stage:
    """A stage that takes a while to its target."""

    def __init__(self) -> None:
        self.mm, self.target, self.may_arrive = 0.0, 0.0, threading.Event()

    def go_to(self, mm: float) -> None:
        self.target = mm
        self.may_arrive.wait(DEADLINE_S)
        self.mm = mm


@pytest.fixture
def stage() -> Stage:
    return Stage()


MOVER = """parameters = { "lab.stage-x" = "stage" }

[limits."lab.stage-x"]
step = "5 mm"

[limits.movers]
retraction = 40
x-coarse-away = { direction = "away", steps = 20, total = 2000 }

[limits.movers."lab.stage-x"]
direction = "lateral"
total = "20 mm"
"""


@pytest.fixture
def scope(tmp_path: Path, stage: Stage, request: pytest.FixtureRequest) -> Iterator[afspm.Scope]:
    sample: Any = loaded()
    modules = {"stage": sample.Module("stage", "mm", get=lambda: stage.mm, set=stage.go_to)}
    with sample.Server(modules, port=0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        text = EXPERIMENT.replace("PORT", str(server.server_address[1]))
        head, _, _ = text.rpartition("parameters =")
        with running(tmp_path, head + getattr(request, "param", STAGE)) as made:
            yield made
        stage.may_arrive.set()
        server.shutdown()


def test_stage_moves_only_while_the_tip_is_withdrawn_and_the_tip_returns_when_it_stands(
    scope: afspm.Scope, stage: Stage
) -> None:
    assert measured(scope, "lab.stage-x") == 0.0
    with pytest.raises(
        Refused, match=r"a change of lab\.stage-x is forbidden while x-engaged = true.*withdraw the tip"
    ):
        scope.set("lab.stage-x", 3.0, "mm")
    assert stage.target == 0.0
    with scope.control():
        scope.action("x-retract")
        scope.wait_until(lambda: scope.tip is not None and scope.tip.engaged is False, timeout_s=DEADLINE_S)
        scope.set("lab.stage-x", 3.0, "mm")
        with pytest.raises(Refused, match=r"x-engage is forbidden while lab\.stage-x\.busy = true"):
            scope.action("x-engage")
        stage.may_arrive.set()
        assert scope.set("lab.stage-x", 3.0, "mm", wait=True) == pytest.approx(3.0)
        scope.action("x-engage")
        assert scope.wait_until(lambda: scope.tip is not None and scope.tip.engaged is True, timeout_s=DEADLINE_S)


@pytest.mark.parametrize("scope", [MOVER], indirect=True)
def test_stage_moves_under_a_retracted_tip_and_nothing_is_measured_before_the_approach(
    scope: afspm.Scope, stage: Stage
) -> None:
    stage.may_arrive.set()
    assert measured(scope, "lab.stage-x") == 0.0
    with scope.control():
        with pytest.raises(Refused, match="0 of 40 steps away"):
            scope.set("lab.stage-x", 3.0, "mm")
        scope.withdraw("x-coarse-away", "x-coarse-away", timeout_s=DEADLINE_S)
        stage.may_arrive.clear()
        scope.set("lab.stage-x", 3.0, "mm")
        with pytest.raises(Refused, match=r"x-approach is forbidden while lab\.stage-x\.busy = true"):
            scope.action("x-approach")
        stage.may_arrive.set()
        assert scope.set("lab.stage-x", 3.0, "mm", wait=True) == pytest.approx(3.0)
        with pytest.raises(Refused, match="has moved since the last approach"):
            scope.scan(shape=(8, 8))
        with pytest.raises(Refused, match="the tip is withdrawn"):
            scope.sweep_at("tip-bias-voltage", ["0 V", "10 mV"], read="x-current")
        scope.approach(timeout_s=DEADLINE_S)
        scope.scan(shape=(8, 8))
    away = ["x-coarse-away"] * 2
    with scope.sweep({"lab.stage-x": ["1 mm", "2 mm"]}, shape=(8, 8), withdraw=away, timeout_s=DEADLINE_S) as points:
        assert [point.values["lab.stage-x"] for point in points] == [pytest.approx(1e-3), pytest.approx(2e-3)]
    assert stage.mm == pytest.approx(3.0), "it is set back, under a retracted tip"
    assert scope.tip is not None
    assert scope.tip.engaged is False
