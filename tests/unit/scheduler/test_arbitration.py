"""The arbitration table: the rules of the paper, and the cases that the paper leaves open."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import chain
from types import MappingProxyType

import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.model import STOPPED_BY_AGENT, ControlMode, ControlResponse, ProblemNames
from afspm.model.problems import QUIET_HOURS
from afspm.model.snapshot import from_plain, to_plain
from afspm.scheduler.control.arbitration import (
    OTHERWISE,
    TABLE,
    ArbitrationEvent,
    ArbitrationState,
    Cause,
    ControlChange,
    ControlInput,
    RoleTable,
    Rules,
    Transition,
    apply,
    reason,
    row_for,
)
from afspm.scheduler.control.descriptions import is_routine

TIP, MALFUNCTION, FEEDBACK, NAMED = 1, 2, 3, 40
RULES = Rules(problems=ProblemNames({"lost-molecule": NAMED}))
MANUAL, AUTOMATED = int(ControlMode.MANUAL), int(ControlMode.AUTOMATED)


def after(*asks: ControlInput, rules: Rules = RULES) -> tuple[ArbitrationState, Transition]:
    """Return the state after a sequence of events, and the row of its last event."""
    control = ArbitrationState()
    for ask in asks:
        row = row_for(control, ask, rules)
        control = apply(row, control, ask)
    return control, row


def request(who: str, problem: int = 0) -> ControlInput:
    return ControlInput(ArbitrationEvent.REQUEST_CONTROL, who, problem)


def flag(who: str, problem: int) -> ControlInput:
    return ControlInput(ArbitrationEvent.FLAG, who, problem)


def clear(who: str, problem: int) -> ControlInput:
    return ControlInput(ArbitrationEvent.CLEAR, who, problem)


def mode(number: int, who: str = "person") -> ControlInput:
    return ControlInput(ArbitrationEvent.SET_MODE, who, number)


def test_each_event_has_a_last_row_that_always_applies() -> None:
    for event in ArbitrationEvent:
        rows = TABLE[event]
        assert rows[-1].when is OTHERWISE
        assert all(row.when is not OTHERWISE for row in rows[:-1])


def test_every_row_can_apply() -> None:
    roles = RoleTable(end_experiment=("boss",), set_mode=("boss",), clear_problems=("boss",), operate=("boss",))
    met = set()
    stopping = Rules(problems=ProblemNames({STOPPED_BY_AGENT: 99}), agents=frozenset({"a"}))
    approving = Rules(RoleTable(approve=("boss",)))
    resting = Rules(problems=ProblemNames({QUIET_HOURS: 99}))
    plain = (RULES, Rules(roles), approving, Rules(end_on=frozenset({TIP})), Rules(shadow=True))
    for rules in (*plain, stopping, resting):
        for control in _states():
            for event in ArbitrationEvent:
                for who in ("a", "b", "boss"):
                    for number in (0, 1, 2, 3, 99):
                        met.add(id(row_for(control, ControlInput(event, who, number), rules)))
    assert [row for rows in TABLE.values() for row in rows if id(row) not in met] == []


@given(
    st.lists(
        st.builds(
            ControlInput,
            st.sampled_from(list(ArbitrationEvent)),
            st.sampled_from(["a", "b", "boss"]),
            st.sampled_from([0, MANUAL, AUTOMATED, TIP, MALFUNCTION, 99]),
        ),
        max_size=12,
    )
)
def test_shadow_gives_no_control_and_forwards_only_reading(asks: list[ControlInput]) -> None:
    rules = Rules(RoleTable(operate=("boss",), set_mode=("boss",)), end_on=frozenset({TIP}), shadow=True)
    control = ArbitrationState(ControlMode.MANUAL)
    for ask in asks:
        row = row_for(control, ask, rules)
        control = apply(row, control, ask)
        assert (control.mode, control.holder) == (ControlMode.MANUAL, None)
        assert set(control.problems) <= {MALFUNCTION}
        assert ask.event is ArbitrationEvent.READ or ControlChange.FORWARD not in row.do


def test_a_cause_is_given_where_control_is_taken_and_only_there() -> None:
    for row in chain(*TABLE.values()):
        assert (row.cause is not None) == any(do.name == "TAKE" for do in row.do)


def test_first_client_gets_control_until_it_is_released() -> None:
    control, row = after(request("experiment"), request("greedy"))
    assert (control.holder, row.response) == ("experiment", ControlResponse.ALREADY_UNDER_CONTROL)
    control, row = after(
        request("experiment"), ControlInput(ArbitrationEvent.RELEASE_CONTROL, "experiment"), request("greedy")
    )
    assert (control.holder, row.response) == ("greedy", ControlResponse.SUCCESS)


def test_the_paper_s_story_of_a_tip_that_changes() -> None:
    story = [request("experiment"), flag("classifier", TIP)]
    control, row = after(*story)
    assert (control.holder, row.cause) == (None, Cause.PROBLEM)
    assert after(*story, request("experiment"))[1].response is ControlResponse.WRONG_EXP_PROBLEM
    story.append(request("corrector", TIP))
    control, row = after(*story)
    assert (control.holder, control.solving, row.response) == ("corrector", TIP, ControlResponse.SUCCESS)
    story.append(clear("classifier", TIP))
    control, row = after(*story)
    assert (control.holder, row.cause) == (None, Cause.SOLVED)
    assert after(*story, request("experiment"))[0].holder == "experiment"


@pytest.mark.parametrize("who", ["classifier", "corrector", "person"])
def test_any_component_may_clear_a_flag_without_roles(who: str) -> None:
    control, row = after(flag("classifier", TIP), clear(who, TIP))
    assert (dict(control.problems), row.response) == ({}, ControlResponse.SUCCESS)


def test_with_roles_the_flag_of_another_is_cleared_only_by_its_solver_or_the_role() -> None:
    rules = Rules(RoleTable(clear_problems=("boss",)))
    flagged = flag("classifier", TIP)
    control, row = after(flagged, clear("stranger", TIP), rules=rules)
    assert (set(control.problems), row.response) == ({TIP}, ControlResponse.FAILURE)
    assert "stranger" in reason(row, control, clear("stranger", TIP), rules)
    for who in ("classifier", "boss"):
        assert not after(flagged, clear(who, TIP), rules=rules)[0].problems
    assert not after(flagged, request("corrector", TIP), clear("corrector", TIP), rules=rules)[0].problems


def test_a_flag_raised_twice_is_a_success_that_changes_nothing() -> None:
    once, _ = after(flag("classifier", TIP))
    twice, row = after(flag("classifier", TIP), flag("other", TIP))
    assert (once, row.response) == (twice, ControlResponse.SUCCESS)


def test_a_flag_raised_again_does_not_take_control_from_its_solver() -> None:
    control, _ = after(flag("classifier", TIP), request("corrector", TIP), flag("classifier", TIP))
    assert control.holder == "corrector"


def test_clearing_an_unset_flag_succeeds_and_changes_no_control() -> None:
    control, row = after(request("experiment"), clear("classifier", TIP))
    assert (control.holder, row.response) == ("experiment", ControlResponse.SUCCESS)


def test_a_stranger_s_release_is_refused_and_harmless() -> None:
    control, row = after(request("experiment"), ControlInput(ArbitrationEvent.RELEASE_CONTROL, "stranger"))
    assert (control.holder, row.response) == ("experiment", ControlResponse.NOT_IN_CONTROL)


def test_the_holder_may_ask_again() -> None:
    control, row = after(request("experiment"), request("experiment"))
    assert (control.holder, row.response) == ("experiment", ControlResponse.SUCCESS)


def test_a_solver_may_go_over_to_another_flagged_problem() -> None:
    control, _ = after(flag("c", TIP), flag("c", FEEDBACK), request("fixer", TIP), request("fixer", FEEDBACK))
    assert (control.holder, control.solving) == ("fixer", FEEDBACK)
    assert after(flag("c", TIP), flag("c", FEEDBACK), request("fixer", TIP), clear("c", TIP))[0].holder is None


def test_control_for_an_unflagged_problem_is_refused() -> None:
    assert after(request("corrector", TIP))[1].response is ControlResponse.WRONG_EXP_PROBLEM
    assert after(flag("c", FEEDBACK), request("corrector", TIP))[1].response is ControlResponse.WRONG_EXP_PROBLEM


def test_a_second_problem_leaves_control_with_the_solver_of_the_first() -> None:
    story = [flag("c", TIP), request("corrector", TIP), flag("c", FEEDBACK)]
    assert after(*story)[0].holder == "corrector"
    assert after(*story, clear("c", FEEDBACK))[0].holder == "corrector"
    control, _ = after(*story, clear("c", TIP))
    assert (control.holder, set(control.problems)) == (None, {FEEDBACK})


def test_malfunction_takes_control_from_solvers_of_other_problems() -> None:
    story = [flag("c", TIP), request("corrector", TIP), flag("scheduler", MALFUNCTION)]
    control, row = after(*story)
    assert (control.holder, row.cause) == (None, Cause.PROBLEM)
    assert after(*story, request("corrector", TIP))[1].response is ControlResponse.WRONG_EXP_PROBLEM
    assert after(*story, request("mender", MALFUNCTION))[0].holder == "mender"
    assert after(*story, clear("person", MALFUNCTION), request("corrector", TIP))[0].holder == "corrector"


def test_manual_takes_control_and_refuses_requests_until_automated() -> None:
    story = [request("experiment"), mode(MANUAL)]
    control, row = after(*story)
    assert (control.holder, row.cause) == (None, Cause.MANUAL)
    assert after(*story, request("experiment"))[1].response is ControlResponse.WRONG_CONTROL_MODE
    assert after(*story, mode(AUTOMATED), request("experiment"))[0].holder == "experiment"


def test_problems_may_be_flagged_and_cleared_in_manual() -> None:
    control, _ = after(mode(MANUAL), flag("c", TIP), flag("c", FEEDBACK), clear("c", TIP))
    assert set(control.problems) == {FEEDBACK}


def test_unknown_mode_is_refused() -> None:
    control, row = after(mode(0))
    assert (control.mode, row.response) == (ControlMode.AUTOMATED, ControlResponse.WRONG_CONTROL_MODE)


def test_setting_the_present_mode_changes_no_control() -> None:
    assert after(request("experiment"), mode(AUTOMATED))[0].holder == "experiment"


def test_problems_named_in_the_experiment_file_work_like_the_numbered_ones() -> None:
    control, _ = after(flag("c", NAMED), request("fixer", NAMED))
    assert (control.holder, control.solving) == ("fixer", NAMED)


@pytest.mark.parametrize("problem", [0, 77, 255])
def test_unknown_problem_is_refused(problem: int) -> None:
    for ask in (flag("c", problem), clear("c", problem)):
        control, row = after(ask)
        assert (dict(control.problems), row.response) == ({}, ControlResponse.WRONG_EXP_PROBLEM)


def test_only_the_holder_commands_and_all_components_read() -> None:
    assert after(request("experiment"), ControlInput(ArbitrationEvent.COMMAND, "experiment"))[1].response is None
    assert (
        after(request("experiment"), ControlInput(ArbitrationEvent.COMMAND, "other"))[1].response
        is ControlResponse.NOT_IN_CONTROL
    )
    assert after(ControlInput(ArbitrationEvent.COMMAND, "other"))[1].response is ControlResponse.NOT_IN_CONTROL
    assert after(request("experiment"), ControlInput(ArbitrationEvent.READ, "other"))[1].response is None


def test_an_operator_commands_in_manual_only() -> None:
    rules = Rules(RoleTable(operate=("console",)))
    command = ControlInput(ArbitrationEvent.COMMAND, "console")
    assert after(mode(MANUAL), command, rules=rules)[1].response is None
    assert after(command, rules=rules)[1].response is ControlResponse.NOT_IN_CONTROL
    assert after(mode(MANUAL), command)[1].response is ControlResponse.NOT_IN_CONTROL


@pytest.mark.parametrize("who", ["terminal:ada", "dashboard:Ada"])
def test_person_says_in_manual_alone_that_the_feedback_is_off(who: str) -> None:
    rules = Rules(RoleTable(operate=("dashboard",), approve=("dashboard", "terminal")), agents=frozenset({"agent"}))
    said = ControlInput(ArbitrationEvent.FEEDBACK_OFF, who)
    assert after(mode(MANUAL), said, rules=rules)[1].response is None
    assert after(said, rules=rules)[1].response is ControlResponse.NOT_IN_CONTROL
    assert after(request(who), said, rules=rules)[1].response is ControlResponse.NOT_IN_CONTROL
    shadow = replace(rules, shadow=True)
    assert after(mode(MANUAL), said, rules=shadow)[1].response is ControlResponse.NOT_IN_CONTROL


def test_an_operator_adjusts_beside_the_holder_while_no_problem_is_flagged() -> None:
    rules = Rules(RoleTable(operate=("console",)))

    def response(who: str, *before: ControlInput) -> ControlResponse | None:
        return after(*before, ControlInput(ArbitrationEvent.ADJUST, who), rules=rules)[1].response

    assert response("console", request("experiment")) is None
    assert response("experiment", request("experiment")) is None
    assert response("console", mode(MANUAL)) is None
    assert response("other", request("experiment")) is ControlResponse.NOT_IN_CONTROL
    assert response("console", flag("c", TIP), request("corrector", TIP)) is ControlResponse.NOT_IN_CONTROL
    assert response("corrector", flag("c", TIP), request("corrector", TIP)) is None


def test_roles_limit_ending_and_switching_the_mode() -> None:
    rules = Rules(RoleTable(end_experiment=("boss",), set_mode=("boss",)))
    assert after(ControlInput(ArbitrationEvent.END, "other"), rules=rules)[1].response is ControlResponse.FAILURE
    assert after(ControlInput(ArbitrationEvent.END, "boss"), rules=rules)[0].ended
    assert after(mode(MANUAL, "other"), rules=rules)[1].response is ControlResponse.FAILURE
    assert after(mode(MANUAL, "boss"), rules=rules)[0].mode is ControlMode.MANUAL


def test_problem_in_end_on_ends_the_experiment() -> None:
    rules = Rules(end_on=frozenset({TIP}))
    control, row = after(request("experiment"), flag("classifier", TIP), rules=rules)
    assert (control.ended, row.response) == (True, ControlResponse.SUCCESS)
    assert not after(flag("classifier", FEEDBACK), rules=rules)[0].ended


def test_refusal_names_client_and_holder() -> None:
    control, _ = after(request("experiment"))
    ask = request("greedy")
    assert reason(row_for(control, ask, RULES), control, ask, RULES).startswith("experiment is in control")
    flagged, _ = after(flag("c", TIP))
    assert "tip-shape-changed" in reason(row_for(flagged, ask, RULES), flagged, ask, RULES)


def test_every_refusal_has_a_reason_that_can_be_formatted() -> None:
    for event, row in [(event, row) for event, rows in TABLE.items() for row in rows]:
        if row.response not in (None, ControlResponse.SUCCESS):
            assert reason(row, ArbitrationState(), ControlInput(event, "somebody", 1), RULES)


asks = st.builds(
    ControlInput,
    st.sampled_from(ArbitrationEvent),
    st.sampled_from(["a", "b", "c"]),
    st.sampled_from([0, 1, 2, 3, NAMED, 99]),
)


@given(st.lists(asks, max_size=40))
def test_no_sequence_of_events_breaks_the_invariants(story: list[ControlInput]) -> None:
    control = ArbitrationState()
    for ask in story:
        before, row = control, row_for(control, ask, RULES)
        control = apply(row, before, ask)
        assert control.holder is None or control.mode is ControlMode.AUTOMATED
        if control.problems:
            assert control.holder is None or control.solving in control.problems
        else:
            assert control.solving == 0
        if before.holder is not None:
            assert control.holder in (None, before.holder)
        assert set(control.problems) <= set(RULES.problems.values())
        assert from_plain(ArbitrationState, json.loads(json.dumps(to_plain(control)))) == control


def _states() -> list[ArbitrationState]:
    states = [ArbitrationState(ended=True)]
    for flagged in ({}, {1: "a"}, {1: "a", 2: "b"}, {99: "a"}, {1: "a", 99: "b"}):
        problems = MappingProxyType(flagged)
        states += [ArbitrationState(m, None, 0, problems) for m in (ControlMode.MANUAL, ControlMode.AUTOMATED)]
        states += [ArbitrationState(ControlMode.AUTOMATED, "a", solving, problems) for solving in (flagged or {0: ""})]
    return states


def test_giving_control_back_and_taking_it_again_is_routine_to_the_log() -> None:
    free, held = ArbitrationState(), ArbitrationState(holder="series")
    back = ControlInput(ArbitrationEvent.RELEASE_CONTROL, "series")
    ask = ControlInput(ArbitrationEvent.REQUEST_CONTROL, "series")
    assert is_routine(held, free, back, "series")
    assert is_routine(free, held, ask, "series")


def test_changes_beyond_routine_are_logged() -> None:
    free, held = ArbitrationState(), ArbitrationState(holder="series")
    ask = ControlInput(ArbitrationEvent.REQUEST_CONTROL, "series")
    flagged = ArbitrationState(problems={1: "classifier"})
    assert not is_routine(free, held, ask, None)  # the first to be in control
    assert not is_routine(free, held, ask, "corrector")  # another than before
    assert not is_routine(held, free, ControlInput(ArbitrationEvent.DEAD, "series"), "series")
    assert not is_routine(held, flagged, ControlInput(ArbitrationEvent.FLAG, "classifier", 1), "series")
    assert not is_routine(flagged, free, ControlInput(ArbitrationEvent.CLEAR, "classifier", 1), "series")
    solving = ArbitrationState(holder="corrector", solving=1, problems={1: "classifier"})
    assert not is_routine(solving, flagged, ControlInput(ArbitrationEvent.RELEASE_CONTROL, "corrector"), "corrector")
