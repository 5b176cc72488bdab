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


@pytest.fixture
def scope(tmp_path: Path, stage: Stage) -> Iterator[afspm.Scope]:
    sample: Any = loaded()
    modules = {"stage": sample.Module("stage", "mm", get=lambda: stage.mm, set=stage.go_to)}
    with sample.Server(modules, port=0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        text = EXPERIMENT.replace("PORT", str(server.server_address[1]))
        head, _, _ = text.rpartition("parameters =")
        with running(tmp_path, head + STAGE) as made:
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
