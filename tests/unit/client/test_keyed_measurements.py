"""A keyed scan is taken exactly once, for a kill of the component at any time."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from client_lab import REGION, SCAN_S, Kill9, Lab, LabPort, scope_of
from hypothesis import given, settings
from hypothesis import strategies as st

from afspm import wire
from afspm.basics.errors import ControlLost, InvalidValue, NoResponse, Refused
from afspm.client.command_retry import LOST_AFTER_S, RETRY_S
from afspm.client.keyed_results import KeyedResults, MeasurementResult
from afspm.client.scope import Scope
from afspm.model import (
    RELAY_REQUEST,
    ControlRequest,
    ControlResponse,
    Note,
    Problem,
    Request,
    Response,
    ResponseDetail,
    ScanSet,
    ScopeState,
    Spectrum,
)
from afspm.model.variables import VariableRoles
from afspm.scheduler.control.arbitration import ArbitrationEvent

TILES = [REGION.moved_to((i * 2e-6, 0.0)) for i in range(3)]


def kill_in(lab: Lab, seconds: float, port: LabPort) -> None:
    def die() -> None:
        port.is_dead = True

    lab.at(seconds, die)


def survey(scope: Scope) -> list[ScanSet]:
    return [scope.scan(region, shape=(8, 8), key=f"tile-{i}") for i, region in enumerate(TILES)]


def survive(lab: Lab, folder: Path, kills_s: list[float], *, is_noticed: bool) -> list[ScanSet]:
    """Run the survey, kill it after each of `kills_s` (from the start of each life), and start it again."""
    for life, kill_s in enumerate([*kills_s, None]):
        port = LabPort(lab)
        if kill_s is not None:
            kill_in(lab, kill_s, port)
        try:
            return survey(scope_of(lab, folder, life, port))
        except Kill9:
            if is_noticed:  # the scheduler takes control from the dead, and stops the scan
                lab.does(ArbitrationEvent.DEAD, lab.name)
            lab.restart_component()
    raise AssertionError


def test_a_script_that_starts_from_the_beginning_gets_the_scans_of_its_earlier_life(tmp_path: Path) -> None:
    lab = Lab()
    before = survey(scope_of(lab, tmp_path, 0))
    lab.restart_component()
    after = survey(scope_of(lab, tmp_path, 1))
    assert lab.begun_scans == 3
    assert [s.region for s in before] == [s.region for s in after] == TILES
    assert [s.first.time_ns for s in before] == [s.first.time_ns for s in after]


@settings(max_examples=40, deadline=None)
@given(
    kills_s=st.lists(st.floats(0.0, 2.5 * SCAN_S), min_size=1, max_size=3),
    is_noticed=st.booleans(),
)
def test_every_tile_is_scanned_exactly_once_for_a_kill_at_any_time(kills_s: list[float], *, is_noticed: bool) -> None:
    lab = Lab()
    with TemporaryDirectory() as folder:
        scans = survive(lab, Path(folder), kills_s, is_noticed=is_noticed)
    assert [s.region for s in scans] == TILES
    assert lab.finished == TILES
    assert lab.control.holder is None


@pytest.mark.parametrize("is_noticed", [True, False])
@pytest.mark.parametrize("is_late", [True, False])
def test_every_tile_is_scanned_exactly_once_for_a_kill_at_any_step(*, is_late: bool, is_noticed: bool) -> None:
    for deadly_call in range(1, 1000):
        lab = Lab()
        with TemporaryDirectory() as folder:
            port = LabPort(lab, deadly_call, is_late=is_late)
            try:
                survey(scope_of(lab, Path(folder), 0, port))
                break  # survived: all steps were tried
            except Kill9:
                pass
            if is_noticed:
                lab.does(ArbitrationEvent.DEAD, lab.name)
            lab.restart_component()
            survey(scope_of(lab, Path(folder), 1))
        assert lab.finished == TILES, f"killed at call {deadly_call}"
    assert deadly_call > 20


def test_scan_running_over_a_restart_is_taken_up_without_a_request(tmp_path: Path) -> None:
    lab = Lab()
    survive(lab, tmp_path, [50.0], is_noticed=False)
    assert lab.begun_scans == 3


def test_a_scan_that_was_finished_during_the_death_is_found_in_the_cache(tmp_path: Path) -> None:
    lab = Lab()
    port = LabPort(lab)
    kill_in(lab, 50.0, port)
    with pytest.raises(Kill9):
        survey(scope_of(lab, tmp_path, 0, port))
    lab.publish(lab.control.published())
    while lab.happenings:  # nobody takes what arrives
        lab.poll(1000.0)
    lab.restart_component()
    scope_of(lab, tmp_path, 1).scan(TILES[0], shape=(8, 8), key="tile-0")
    assert lab.begun_scans == 1
    assert lab.control.holder is None, "control of the earlier life is given back"


def test_scan_without_a_key_does_not_forget_the_keyed_one(tmp_path: Path) -> None:
    def measure(scope: Scope) -> None:
        scope.spectrum()
        scope.scan(TILES[0], shape=(8, 8), key="tile-0")

    lab = Lab()
    port = LabPort(lab)
    kill_in(lab, 155.0, port)  # the spectrum took 100 s
    with pytest.raises(Kill9):
        measure(scope_of(lab, tmp_path, 0, port))
    while lab.happenings:  # it ends while nobody is there
        lab.poll(1000.0)
    assert len(lab.finished) == 1
    lab.restart_component()
    measure(scope_of(lab, tmp_path, 1))
    assert len(lab.finished) == 1


def test_a_scan_that_is_finished_while_a_later_life_waits_for_control_is_taken_up(tmp_path: Path) -> None:
    lab = Lab()
    lab.begin_unheard(TILES[0], in_s=20.0)
    lab.at(2.0, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))
    lab.at(60.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    port = LabPort(lab)
    kill_in(lab, 5.0, port)
    with pytest.raises(Kill9):
        scope_of(lab, tmp_path, 0, port).scan(TILES[0], shape=(8, 8), key="tile-0")
    lab.restart_component()
    scans = scope_of(lab, tmp_path, 1).scan(TILES[0], shape=(8, 8), key="tile-0")
    assert scans.region == TILES[0]
    assert lab.begun_scans == 1


def test_interruptions_of_an_earlier_life_are_reported(tmp_path: Path) -> None:
    lab = Lab()
    lab.at(20.0, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))
    lab.at(60.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    scans = survive(lab, tmp_path, [100.0], is_noticed=False)
    assert "tip-shape-changed" in scans[0].interruptions[0]


def test_a_key_is_for_one_measurement(tmp_path: Path) -> None:
    lab = Lab()
    scope = scope_of(lab, tmp_path, 0)
    scope.scan(TILES[0], key="same")
    with pytest.raises(InvalidValue, match="another measurement"):
        scope.scan(TILES[1], key="same")


@pytest.mark.parametrize("key", ["", "a/b", "x" * 101, "line\nbreak"])
def test_a_key_must_fit_into_an_id(tmp_path: Path, key: str) -> None:
    with pytest.raises(InvalidValue, match="key"):
        scope_of(Lab(), tmp_path, 0).scan(TILES[0], key=key)


def test_similar_keys_have_different_files(tmp_path: Path) -> None:
    scope = scope_of(Lab(), tmp_path, 0)
    a, b = scope.scan(TILES[0], key="Tile 1"), scope.scan(TILES[1], key="tile 1")
    assert (a.region, b.region) == (TILES[0], TILES[1])


def test_without_a_key_every_call_is_a_new_scan(tmp_path: Path) -> None:
    lab = Lab()
    scope = scope_of(lab, tmp_path, 0)
    scope.scan(TILES[0])
    scope.scan(TILES[0])
    assert lab.begun_scans == 2
    assert not list(tmp_path.iterdir())


def test_a_spectrum_with_a_key_is_taken_once(tmp_path: Path) -> None:
    lab = Lab()
    for life in range(2):
        scope_of(lab, tmp_path, life).spectrum((1e-7, 0.0), key="iv-1")
        lab.restart_component()
    assert lab.begun_scans == 1
    assert lab.count(ControlRequest.SET_PROBE_POS) == 1


def test_saved_curve_keeps_the_roles_of_its_variables(tmp_path: Path) -> None:
    roles = VariableRoles.declared({"force, retrace": ("F back",), "height": ("Z",)}, towards=("Z",))
    values = np.array([[0.0, 1.0], [1e-9, 2.0]])
    curve = Spectrum((0.0, 0.0), "force", ("Z", "F back"), ("m", "N"), values, 1, declared_roles=roles)
    results = KeyedResults(tmp_path, "map")
    results.fulfil("map-1", {}, MeasurementResult([curve], []))
    results.close()
    found = KeyedResults(tmp_path, "map").find("map-1", {})
    assert found is not None
    assert found.spectrum.declared_roles == roles
    assert found.spectrum.of("height").tolist() == [0.0, -1e-9]


def test_scan_after_a_timeout_is_taken_up_by_the_next_call(tmp_path: Path) -> None:
    lab = Lab()
    scope = scope_of(lab, tmp_path, 0)
    with pytest.raises(NoResponse):
        scope.scan(TILES[0], key="tile", timeout_s=0.5 * SCAN_S)
    scope.scan(TILES[0], key="tile")
    assert lab.begun_scans == 1


def test_refused_key_is_requested_again_with_another_id(tmp_path: Path) -> None:
    lab = Lab()
    scope = scope_of(lab, tmp_path, 0)
    lab.intercept = lambda request: Response(ControlResponse.ACTION_ERROR) if request.subject else "go on"
    with pytest.raises(Refused):
        scope.scan(None, key="tile")
    lab.intercept = lambda request: "go on"
    scope.scan(None, key="tile")
    ids = [request.id for request in lab.requests if request.subject == "start-scan"]
    assert ids == ["experiment/key/tile/1", "experiment/key/tile/2"]


def retracted(lab: Lab) -> Callable[[], None]:
    """Retract the tip: scans are refused, and the refusals cached. Return the function that engages it again."""
    execute, is_retracted = lab.execute, [True]

    def carry_out(request: Request) -> Response:
        if is_retracted and request.subject == "start-scan":
            return Response(ControlResponse.ACTION_ERROR, reason="the tip is retracted")
        return execute(request)

    lab.execute = carry_out  # type: ignore[method-assign]
    return is_retracted.clear


def test_scan_refused_in_earlier_lives_is_taken_once_possible(tmp_path: Path) -> None:
    lab = Lab()
    engage = retracted(lab)
    for life in range(3):
        with pytest.raises(Refused, match="retracted"):
            scope_of(lab, tmp_path, life).scan(REGION, shape=(8, 8), key="tile")
        lab.restart_component()
    engage()
    assert scope_of(lab, tmp_path, 3).scan(REGION, shape=(8, 8), key="tile").region == REGION
    assert lab.begun_scans == 1


@pytest.mark.parametrize("is_late", [True, False])
def test_refused_scan_is_taken_once_for_a_kill_at_any_step(*, is_late: bool) -> None:
    for deadly_call in range(1, 1000):
        lab = Lab()
        engage = retracted(lab)
        with TemporaryDirectory() as folder:
            port = LabPort(lab, deadly_call, is_late=is_late)
            with pytest.raises((Kill9, Refused)):
                scope_of(lab, Path(folder), 0, port).scan(REGION, shape=(8, 8), key="tile")
            engage()
            lab.restart_component()
            scope_of(lab, Path(folder), 1).scan(REGION, shape=(8, 8), key="tile")
        assert lab.finished == [REGION], f"killed at call {deadly_call}"
        if not port.is_dead:
            break
    assert deadly_call > 5


def test_forgotten_key_is_measured_again_and_takes_no_space(tmp_path: Path) -> None:
    lab = Lab()
    scope = scope_of(lab, tmp_path, 0)
    survey(scope)
    scope.forget("tile-1")
    scope.forget("tile-1")
    assert len(list(tmp_path.rglob("tile-*"))) == 2
    survey(scope)
    assert lab.finished == [*TILES, TILES[1]]
    with pytest.raises(InvalidValue, match="can't be a key"):
        scope.forget("../tile-1")


def test_forgotten_key_may_be_used_in_a_loop(tmp_path: Path) -> None:
    lab = Lab()
    for life in range(3):
        scope = scope_of(lab, tmp_path, life)
        for _ in range(3):
            assert scope.scan(TILES[0], shape=(8, 8), key="reference").interruptions == ()
            scope.forget("reference")
        lab.restart_component()
    assert lab.begun_scans == 9
    assert lab.clock.passed_s < 9 * SCAN_S + 20.0, "no request had an old id, which starts nothing"


def test_key_forgotten_in_a_later_life_is_measured_again_after_a_kill(tmp_path: Path) -> None:
    lab = Lab()
    scope_of(lab, tmp_path, 0).scan(TILES[0], shape=(8, 8), key="reference")
    lab.restart_component()
    scope_of(lab, tmp_path, 1).forget("reference")  # killed before it has control for the next measurement
    lab.restart_component()
    scope_of(lab, tmp_path, 2).scan(TILES[0], shape=(8, 8), key="reference")
    assert lab.begun_scans == 2


def test_measurement_of_a_forgotten_key_has_no_interruptions_of_the_earlier_one(tmp_path: Path) -> None:
    lab = Lab()
    lab.at(30.0, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))
    lab.at(60.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    assert scope_of(lab, tmp_path, 0).scan(TILES[0], shape=(8, 8), key="reference").interruptions
    lab.restart_component()
    scope = scope_of(lab, tmp_path, 1)
    scope.forget("reference")
    assert scope.scan(TILES[0], shape=(8, 8), key="reference").interruptions == ()


def test_measurement_given_up_for_another_is_taken_at_once_later(tmp_path: Path) -> None:
    lab = Lab()
    scope = scope_of(lab, tmp_path, 0)
    lab.at(50.0, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))
    lab.at(60.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    with pytest.raises(ControlLost):
        scope.scan(TILES[0], shape=(8, 8), key="whole", repeat=False)
    scope.scan(TILES[1], shape=(8, 8), key="rest")
    assert scope.scan(TILES[0], shape=(8, 8), key="whole").interruptions == ()
    assert lab.begun_scans == 3


@pytest.mark.parametrize("left", [0.0, 0.5, 0.99])
def test_a_result_that_a_power_cut_has_damaged_is_measured_again(
    tmp_path: Path, left: float, caplog: pytest.LogCaptureFixture
) -> None:
    lab = Lab()
    survey(scope_of(lab, tmp_path, 0))
    (file,) = (tmp_path / f"{lab.name}.results").glob("tile-1*")
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * left)])
    lab.restart_component()
    lab.answers.clear()  # the scheduler and the translator have lost their last moment, too
    assert len(survey(scope_of(lab, tmp_path, 1))) == 3
    assert lab.begun_scans == 4
    assert "tile-1 is damaged and measured again" in caplog.text


@pytest.mark.parametrize("lives", [1, 2])
def test_scan_whose_start_was_lost_is_requested_with_another_id(lives: int, tmp_path: Path) -> None:
    """A translator that dies in a command, or loses its controller in it, never knows the outcome under this id."""
    lab, lost = Lab(), list[str]()

    def dies(request: Request) -> Response | str:
        if request.subject != "start-scan" or request.id not in (lost or [request.id]):
            return "go on"
        lost.append(request.id)
        return Response(ControlResponse.NO_RESPONSE, reason="the translator was restarted during this request")

    lab.intercept = dies
    for life in range(lives):
        port = LabPort(lab)
        if life < lives - 1:
            kill_in(lab, 30.0, port)
        try:
            scans = scope_of(lab, tmp_path, life, port).scan(REGION, shape=(8, 8), key="tile")
        except Kill9:
            lab.restart_component()
    assert len(set(lost)) == 1
    assert lab.finished == [REGION]
    assert len(scans.interruptions) == 1
    assert lab.control.holder is None


def lose_start(lab: Lab, back_s: float) -> list[tuple[str, float]]:
    """Lose the controller in the first start of a scan; it is back, and free, at `back_s`.

    Return the id and the time of each request to start, filled as they come.
    """
    asked: list[tuple[str, float]] = []

    def loses(request: Request) -> Response | str:
        if request.subject != "start-scan":
            return "go on"
        if not asked:
            lab.go(ScopeState.UNDEFINED)
            lab.at(back_s, lambda: lab.go(ScopeState.FREE))
        asked.append((request.id, lab.clock.passed_s))
        if request.id != asked[0][0]:
            return "go on"
        is_first = len(asked) == 1
        detail = ResponseDetail.OUTCOME_UNKNOWN if is_first else ResponseDetail.NONE
        return Response(ControlResponse.NO_RESPONSE, reason="no answer to Scan.Action", detail=detail)

    lab.intercept = loses
    return asked


@pytest.mark.parametrize("back_s", [2.0, 55.0])
def test_scan_is_started_again_soon_after_a_controller_lost_in_its_start_is_back(back_s: float, tmp_path: Path) -> None:
    lab = Lab()
    asked = lose_start(lab, back_s)
    scope_of(lab, tmp_path, 0).scan(REGION, shape=(8, 8), key="tile")
    first, *_, (second, again_s) = asked
    assert second != first[0]
    assert LOST_AFTER_S <= again_s - first[1] - back_s < LOST_AFTER_S + 2 * RETRY_S
    assert lab.finished == [REGION]


def test_scan_that_begins_late_after_its_controller_is_back_is_not_started_again(tmp_path: Path) -> None:
    lab = Lab()
    asked = lose_start(lab, back_s=2.0)

    def begins() -> None:
        lab.go(ScopeState.SCANNING)
        lab.publish_scan(REGION)
        lab.go(ScopeState.FREE)

    lab.at(2.0 + LOST_AFTER_S - 2 * RETRY_S, begins)
    scans = scope_of(lab, tmp_path, 0).scan(REGION, shape=(8, 8), key="tile")
    assert [scan.region for scan in scans.values()] == [REGION] * 2
    assert len({request_id for request_id, _ in asked}) == 1


def notes_of(lab: Lab) -> list[Note]:
    """Return the published notes; a repetition with the id of an earlier request is not published again."""
    sent = {(request.id, request.payload): request.subject for request in lab.requests if request.kind == RELAY_REQUEST}
    return [wire.decode("Note", one.payload) for one in sent.values() if one.message == "Note"]


@pytest.mark.parametrize("is_late", [False, True])
@pytest.mark.parametrize("deadly_call", range(12))
def test_note_with_a_key_is_written_once_for_a_kill_at_any_call(
    tmp_path: Path, deadly_call: int, *, is_late: bool
) -> None:
    lab = Lab()

    def script(life: int, port: LabPort) -> None:
        scope = scope_of(lab, tmp_path, life, port)
        scope.note("the tip changed", key="tip")
        scope.sleep(1.0)
        scope.note("all is done", key="done")

    for life, port in enumerate((LabPort(lab, deadly_call, is_late=is_late), LabPort(lab), LabPort(lab))):
        with suppress(Kill9):
            script(life, port)
        lab.restart_component()
    assert [note.text for note in notes_of(lab)] == ["the tip changed", "all is done"]


def test_key_of_a_note_is_not_used_for_another_text(tmp_path: Path) -> None:
    lab = Lab()
    scope = scope_of(lab, tmp_path, 0)
    scope.scan(REGION, shape=(8, 8), key="tip")
    scope.note("the tip changed", key="tip")
    with pytest.raises(InvalidValue, match="used for another note"):
        scope.note("the tip is blunt", key="tip")
    with pytest.raises(InvalidValue, match="can't be a key"):
        scope.note("the tip is blunt", key="a/b")
    assert len(notes_of(lab)) == 1
