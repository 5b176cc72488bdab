"""A measurement is begun once for its key, over refusals, losses and kills."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from afspm.basics import ExperimentClock
from afspm.client import BEGUN_WITHIN_S, ScanTarget
from afspm.model import ControlResponse, Frame, Parameter, Region, Response, Scan, ScopeState, ScopeStatus
from afspm.plugins.web.gateway.measurements import Measurement, Measurements
from afspm.plugins.web.gateway.problems import RefusalCode, RefusedRequest
from afspm.plugins.web.person_commands import PersonCommands
from afspm.plugins.web.watch import Watch

REGION = Region((0.0, 0.0), (1e-6, 1e-6))
TARGET = ScanTarget.of(REGION, (4, 4), Frame.TIP)
OK = Response(int(ControlResponse.SUCCESS))
SILENCE = Response(int(ControlResponse.NO_RESPONSE))
NOT_IN_CONTROL = Response(int(ControlResponse.NOT_IN_CONTROL), reason="series is in control")
NOT_FREE = Response(int(ControlResponse.NOT_FREE))


class Commands:
    """A scheduler with given answers that keeps the ids of its requests; `refusal` is its answer to settings."""

    def __init__(self, *answers: Response, refusal: Response | None = None) -> None:
        self.answers = list(answers)
        self.refusal = refusal
        self.ids: list[str] = []

    def prepare_scan(self, region: object, shape: object) -> None:
        pass

    def act_when_free(self, action: str, next_id: Callable[[], str], settings: tuple[Parameter, ...]) -> Response:
        while True:
            if settings and self.refusal is not None:
                return self.refusal
            self.ids.append(next_id())
            if (answer := self.answers.pop(0)).code != ControlResponse.NOT_FREE:
                return answer


class Lab:
    def __init__(self, file: Path) -> None:
        self.now_s = 100.0
        self.watch = Watch(ExperimentClock.real())
        self.kept = Measurements(file, self.watch, lambda: self.now_s)

    def begin(self, commands: Commands, key: str = "tile", target: ScanTarget = TARGET) -> Measurement:
        return self.kept.take("gateway:ada", key, target)(cast("PersonCommands", commands))

    def found(self) -> Measurement:
        found = self.kept.find("gateway:ada", "tile")
        assert found is not None
        return found

    def publish(self, *things: Any, since_ns: int = 1000) -> None:
        for time_ns, thing in enumerate(things, since_ns):
            self.kept.on_packet(ScopeStatus(thing) if isinstance(thing, ScopeState) else thing, time_ns)


def scan(time_ns: int = 77) -> Scan:
    return Scan(REGION, "Height", "m", np.zeros((4, 4)), time_ns)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "measurements.json"


def test_a_finished_measurement_is_not_begun_again(file: Path) -> None:
    lab, commands = Lab(file), Commands(OK)
    assert lab.begin(commands).state == "running"
    lab.publish(ScopeState.SCANNING, scan(), ScopeState.FREE)
    assert (lab.found().state, lab.found().result) == ("done", "77")
    assert lab.begin(commands) == lab.found()
    assert commands.ids == ["gateway:ada/key/tile/1"]


def test_a_refused_attempt_is_followed_by_one_with_another_id(file: Path) -> None:
    lab, commands = Lab(file), Commands(NOT_FREE, NOT_IN_CONTROL, OK)
    with pytest.raises(RefusedRequest) as refused:
        lab.begin(commands)
    assert refused.value.model.code is RefusalCode.NOT_IN_CONTROL
    lab.begin(commands)
    assert commands.ids == [f"gateway:ada/key/tile/{n}" for n in (1, 2, 3)]


def test_an_attempt_of_unknown_outcome_is_repeated_under_its_own_id(file: Path) -> None:
    lab, commands = Lab(file), Commands(SILENCE, OK)
    with pytest.raises(RefusedRequest) as refused:
        lab.begin(commands)
    assert refused.value.model.may_have_been_done
    lab.begin(commands)
    assert commands.ids == ["gateway:ada/key/tile/1"] * 2


def test_an_unanswered_scan_counts_when_its_result_arrives(file: Path) -> None:
    lab = Lab(file)
    with pytest.raises(RefusedRequest):
        lab.begin(Commands(SILENCE))
    lab.publish(ScopeState.SCANNING, scan(), ScopeState.FREE)
    assert lab.found().state == "done"


def test_an_interrupted_measurement_fails_and_may_be_begun_again(file: Path) -> None:
    lab, commands = Lab(file), Commands(OK, OK)
    lab.begin(commands)
    lab.publish(ScopeState.SCANNING, ScopeState.INTERRUPTED)
    assert (lab.found().state, lab.found().model().refusal.code) == ("failed", RefusalCode.INTERRUPTED)  # type: ignore[union-attr]
    assert lab.begin(commands).state == "running"
    assert commands.ids[-1].endswith("/2")


def test_a_measurement_that_never_begins_ends(file: Path) -> None:
    lab = Lab(file)
    lab.begin(Commands(OK))
    assert lab.found().state == "running"
    lab.now_s += BEGUN_WITHIN_S + 1.0
    assert lab.found().model().refusal.code is RefusalCode.NO_RESULT  # type: ignore[union-attr]


def test_a_restarted_gateway_continues_with_the_replay(file: Path) -> None:
    Lab(file).begin(Commands(OK))
    lab = Lab(file)
    assert lab.found().state == "running"
    lab.publish(scan(), ScopeState.FREE)  # the cache has kept the last state only
    assert lab.found().state == "done"
    assert Lab(file).found().state == "done"


def test_a_key_belongs_to_one_measurement_of_one_client(file: Path) -> None:
    lab = Lab(file)
    lab.begin(Commands(OK))
    other = ScanTarget.of(None, None, Frame.TIP)
    with pytest.raises(RefusedRequest) as refused:
        lab.kept.take("gateway:ada", "tile", other)(cast("PersonCommands", Commands()))
    assert refused.value.model.code is RefusalCode.KEY_USED
    assert lab.kept.find("gateway:max", "tile") is None


def at_bias(bias: str) -> ScanTarget:
    return replace(TARGET, settings=(Parameter("tip-bias-voltage", bias, "V"),))


def test_refused_setting_leaves_the_key_for_another_value(file: Path) -> None:
    lab, commands = Lab(file), Commands(OK, refusal=Response(int(ControlResponse.PARAM_ERROR), reason="above 3 V"))
    with pytest.raises(RefusedRequest) as refused:
        lab.begin(commands, target=at_bias("4"))
    assert refused.value.model.code is RefusalCode.PARAMETER_REFUSED
    assert (lab.kept.find("gateway:ada", "tile"), commands.ids) == (None, [])
    commands.refusal = None
    assert lab.begin(commands, target=at_bias("2")).state == "running"


def test_refused_setting_does_not_end_an_attempt_of_unknown_outcome(file: Path) -> None:
    lab = Lab(file)
    with pytest.raises(RefusedRequest):
        lab.begin(Commands(SILENCE), target=at_bias("2"))
    with pytest.raises(RefusedRequest):
        lab.begin(Commands(refusal=NOT_IN_CONTROL), target=at_bias("2"))
    lab.publish(ScopeState.SCANNING, scan(), ScopeState.FREE)
    assert lab.found().state == "done"


def test_settings_belong_to_a_measurement_also_after_a_restart(file: Path) -> None:
    Lab(file).begin(Commands(OK), target=at_bias("2"))
    lab = Lab(file)
    assert lab.begin(Commands(), target=at_bias("2")).state == "running"
    with pytest.raises(RefusedRequest) as refused:
        lab.begin(Commands(), target=at_bias("1"))
    assert refused.value.model.code is RefusalCode.KEY_USED


def test_a_grid_of_several_thousand_keys_is_not_begun_again(file: Path) -> None:
    lab = Lab(file)
    lab.begin(Commands(OK))
    lab.publish(ScopeState.SCANNING, scan(), ScopeState.FREE)
    for number in range(5000):
        lab.kept._kept["gateway:ada", str(number)] = Measurement("gateway:ada", str(number), {}, state="done")
    lab.begin(Commands(OK), "another")
    assert lab.begin(Commands()).state == "done"
    assert Lab(file).begin(Commands()).state == "done"
