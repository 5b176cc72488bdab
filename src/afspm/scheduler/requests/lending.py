"""The settings of a measurement: set before it, and set back before a measurement that does not state them.

A LEND, the start of a measurement or treatment, and a RETURN take a turn of several steps:

1. the values in force are read in one request, and compared with the book (`loans.LoanBook.compared`);
2. the changes are ordered once (`setting_order.widening_first`), and sent in the steps that limits allow, each
   checked right before it is sent, as a request of a client would be;
3. a change of bias, setpoint or gains with the tip at the sample settles;
4. a LEND or RETURN is answered; a start goes on through the stages of `request_pipeline`.

Nothing is changed in MANUAL, and while z is held, whose way back is the translator's. A RETURN that the scheduler makes
by itself is a request of its own in the same queue, behind all others.
"""

from __future__ import annotations

from collections.abc import Mapping

from afspm.basics.frozen import replace
from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlResponse,
    Feedback,
    Parameter,
    Problem,
    Request,
    Response,
    ResponseDetail,
    names,
)
from afspm.model.microscope_status import STOPS
from afspm.model.positions import PLACES
from afspm.model.requests import (
    COMPARE_REQUEST,
    KEEP_REQUEST,
    LEND_REQUEST,
    RETURN_REQUEST,
    LoansInForce,
    Overruling,
    Setting,
    Settings,
    amount_text,
)
from afspm.model.setting_order import widening_first
from afspm.scheduler.control.descriptions import feedback_values
from afspm.scheduler.events import RequestIn
from afspm.scheduler.loans import SETTLES, Loan, LoanBook, equal, key_of, kind_of, may_be_lent
from afspm.scheduler.overrulings import StatedValue
from afspm.scheduler.publishing.event_log import SCHEDULER
from afspm.scheduler.publishing.own_packets import publish
from afspm.scheduler.requests import answers, approvals
from afspm.scheduler.requests.forwarder import CompareForTurn, ForwardedRequest, ReadForTurn, SetForTurn
from afspm.scheduler.requests.pending_requests import Lending, Turn, WayStep
from afspm.scheduler.safety import present_state
from afspm.scheduler.state import SchedulerState, StateDraft
from afspm.wire.messages import LENT_SETTINGS, LOANS

MEASURES = frozenset((names.START_SCAN, names.START_SPEC, names.HOLD_Z, *names.TREATMENTS, *names.APPROACHES))
"""The actions that take place with what was stated for them, and with the base of all else."""
_AGAIN_S = 5.0  # real, after a return that could not be made
COMPARED = "all that the turn compares"
"""The name under which a turn awaits the values in force."""


def takes_turn(draft: StateDraft, job: ForwardedRequest) -> bool:
    """Return whether settings may have to be changed for a request, before all its other decisions."""
    request = job.request
    if request.kind in (LEND_REQUEST, RETURN_REQUEST):
        return True
    if request.kind != ControlRequest.ACTION or request.subject not in MEASURES or job.is_repeated:
        return False
    if not draft.loans.loans or draft.control.mode is ControlMode.MANUAL or draft.microscope.risk.holds_z:
        return False
    kinds = {loan.kind for loan in draft.loans.loans.values()}
    return any(draft.loans.due(str(request.subject), kind) for kind in kinds)


def take_return(draft: StateDraft, event: RequestIn) -> bool:
    """Process a RETURN; return whether it is queued, and answered once all is set back."""
    given = [one.name for one in event.request.subject.parameters]
    draft.loans = draft.loans.returned_by(event.name, given)
    if not given and not draft.control.solving:
        draft.plans = draft.plans.ended(event.name)
    if is_to_return(draft.loans) and may_return(draft):
        return True
    answers.answer(draft, event, ControlResponse.SUCCESS)
    return False


def before_returns(draft: StateDraft) -> list[ForwardedRequest]:
    """Return the waiting requests without those to set back, which give way to commands after their first step."""
    others, turn = [job for job in draft.forwarder.queue if job.request.kind != RETURN_REQUEST], draft.pending.turn
    if turn is not None and turn.lending is not None and turn.lending.has_set and any(job.command for job in others):
        of_turn = draft.forwarder.waiting(turn.number)
        if of_turn is not None and of_turn.request.kind == RETURN_REQUEST:
            draft.pending = replace(draft.pending, turn=None)
    return others


def refuses_forgotten(draft: StateDraft, job: ForwardedRequest) -> bool:
    """Refuse a start, once, whose client may have stated something that is not known any more, as after a restart."""
    is_start = job.request.kind == ControlRequest.ACTION and job.request.subject in MEASURES and not job.is_repeated
    if not is_start or job.client != draft.loans.lent_last:
        return False
    if draft.loans.token not in (None, draft.peers.sessions.token(job.client)):  # its earlier life has stated that
        draft.loans = replace(draft.loans.nothing_stated(), is_broken=False)
    if not draft.loans.is_broken:
        return False
    draft.loans = replace(draft.loans, is_broken=False)
    why = "what was stated for this measurement is not known any more: state it again"
    refusal = Response(int(ControlResponse.NOT_FREE), b"", why, job.request.id, ResponseDetail.STATE_AGAIN)
    _answer_unsent(draft, job, refusal)
    return True


def advance(draft: StateDraft, job: ForwardedRequest, turn: Turn) -> Turn | None:
    """Carry the settings before a request one step further.

    Returns:
        The turn of a start whose settings are in force. None: the request waits, or was answered.
    """
    if turn.lending is None:
        _begin(draft, job, turn)
        return None
    lending = turn.lending
    if lending.way == () and lending.kind_before and not lending.compared:  # of another kind of curve, now in force
        _begin(draft, job, turn)
        return None
    if lending.way is None:
        decided = _decided(draft, job, turn, lending)
        if decided is None:
            return None
        lending = decided
    while lending.way:
        lending_or_none = _sent_step(draft, job, turn, lending)
        if lending_or_none is None:
            return None
        lending = lending_or_none
    if _starts_other_kind(draft, job, turn, lending):
        return None
    if lending.changes_loop and lending.settles_ns is None and job.request.kind != RETURN_REQUEST:
        settle_s = _settle_s(draft, job)
        if settle_s > 0.0:
            settles_ns = draft.now_ns + round(settle_s * 1e9)
            draft.forwarder = draft.forwarder.waiting_longer(job.number, settle_s)
            draft.pending = replace(draft.pending, turn=replace(turn, lending=replace(lending, settles_ns=settles_ns)))
            return None
    if job.request.kind == ControlRequest.ACTION:
        return Turn(turn.number, lending=Lending(is_done=True))
    _finish(draft, job, lending)
    return None


# --- 1. read and compared ---------------------------------------------------------------------------------------------


def _begin(draft: StateDraft, job: ForwardedRequest, turn: Turn) -> None:
    before = turn.lending or Lending()
    if (state := draft.microscope.state) in STOPS:  # of a measurement that another has asked for, or an earlier life
        why = f"the microscope is not free: {state.name}"
        _answer_unsent(draft, job, Response(int(ControlResponse.NOT_FREE), b"", why, job.request.id))
        return
    if job.request.kind == RETURN_REQUEST and not may_return(draft):
        _finish(draft, job, Lending())
        return
    stated = _stated(draft, job, draft.limits.kind_of_curve)
    if place := next((one.name for one in stated if one.name in PLACES), ""):
        why = f"{place} says where to measure, and is no setting of a measurement: set it before"
        _refuse(draft, job, Response(int(ControlResponse.PARAM_ERROR), b"", why, job.request.id))
        return
    draft.loans = draft.loans.used(draft.now_ns)
    asked = _to_compare(draft, stated)
    if not asked:
        _finish(draft, job, Lending())
        return
    possible = [*stated, *(loan.base for loan in draft.loans.loans.values())]
    others = [name for one in possible for name in draft.limits.depends_on(Request(int(ControlRequest.PARAM), one))]
    others += [name for one in stated for name in draft.grants.depends_on(job.client, _as_param(job, one))]
    needed = set(others) - asked.keys()
    if draft.loans.is_compared:
        settings = Settings(tuple(asked.values()))
        request = Request(COMPARE_REQUEST, settings)
        draft.forwarder, _ = draft.forwarder.ask_own(request, draft.now_s, CompareForTurn(job.number))
        needed.add(COMPARED)
    else:
        needed |= asked.keys()
    lending = Lending(stated=stated, kind_before=before.kind_before, later=before.later)
    reading = replace(turn.reading(frozenset(needed)), lending=lending)
    draft.pending = replace(draft.pending, turn=reading)
    for name in sorted(needed - {COMPARED}):
        request = Request(int(ControlRequest.PARAM), Parameter(name))
        draft.forwarder, _ = draft.forwarder.ask_own(request, draft.now_s, ReadForTurn(job.number, name))


def _to_compare(draft: StateDraft, stated: tuple[Parameter, ...]) -> dict[str, Setting]:
    # by name, each with the values that may be in force; of a value to lend, that one comes first, and is claimed
    found: dict[str, Setting] = {}
    for one in stated:
        found[one.name] = Setting(Parameter(one.name, None, one.unit), (one,), is_claimed=True)
    second = names.SAMPLE_BIAS
    if names.TIP_BIAS_VOLTAGE in found and draft.env.settings.limits.bias.may_have_second:
        found.setdefault(second, Setting(Parameter(second)))
    for loan in draft.loans.loans.values():
        before = found.get(loan.name, Setting(Parameter(loan.name, None, loan.value.unit)))
        known = (*before.known, loan.value, loan.base, *((loan.before,) if loan.before else ()))
        found[loan.name] = replace(before, known=known)
    if found and any(name in names.OF_CURVES for name in found):
        found[names.SPEC_KIND] = Setting(Parameter(names.SPEC_KIND))
    return found


def take_compared(draft: StateDraft, number: int, response: Response) -> None:
    """Store the translator's answer about the values in force."""
    turn, job = draft.pending.turn, draft.forwarder.waiting(number)
    if turn is None or job is None or turn.number != number or turn.lending is None:
        return
    found = draft.env.codec.decode_packet(LENT_SETTINGS.name, response.payload) if response.ok else None
    if isinstance(found, Settings):
        compared = {one.parameter.name: one for one in found.settings}
        values = {**turn.values, **{name: one.parameter for name, one in compared.items()}}
        turn = replace(turn.lacks(COMPARED), values=values, lending=replace(turn.lending, compared=compared))
        draft.pending = replace(draft.pending, turn=turn)
    elif response.code == ControlResponse.CMD_NOT_SUPPORTED:  # a translator of another make: the values are read
        draft.loans = replace(draft.loans, is_compared=False)
        draft.pending = replace(draft.pending, turn=Turn(number))
    elif response.code == ControlResponse.NO_RESPONSE:
        why = f"not sent: the read before it failed ({response.reason})"
        _answer_unsent(draft, job, replace(response, reason=why))
    else:
        _answer_unsent(draft, job, response)


def take_set(draft: StateDraft, purpose: SetForTurn, response: Response) -> None:
    """Store the answer to a step on the way of a loan, also if its request does not wait any more."""
    answered = draft.env.codec.decode_parameter(response.payload) if response.payload else None
    if response.ok:
        in_force = answered if answered is not None and answered.value is not None else None
        if in_force is not None:
            draft.loans = draft.loans.answered(purpose.key, in_force)
        if purpose.ends_loan:
            draft.loans = draft.loans.gone([purpose.key])
    elif response.code != ControlResponse.NO_RESPONSE:
        draft.loans = draft.loans.refused(purpose.key, response.reason if purpose.is_back else "")
    turn, job = draft.pending.turn, draft.forwarder.waiting(purpose.number)
    lending = None if turn is None or turn.number != purpose.number else turn.lending
    if turn is None or job is None or lending is None or not lending.way:
        return
    step = lending.way[0]
    if response.ok:
        in_force = answered if answered is not None and answered.value is not None else lending.sent
        assert in_force is not None
        name = step.target.name
        is_there = lending.sent == step.target
        moved = replace(
            lending,
            now={**lending.now, name: in_force},
            way=lending.way[1:] if is_there else lending.way,
            sent=None,
            has_set=True,
            changes_loop=lending.changes_loop or (name in SETTLES and not draft.microscope.risk.tip_away),
        )
        values = {**turn.values, name: in_force}
        draft.pending = replace(draft.pending, turn=replace(turn.lacks(name), values=values, lending=moved))
        if not is_there and lending.now.get(name) == in_force:  # a controller whose resolution is wider than the step
            why = f"{name} stays at {amount_text(in_force)}, where a step to {amount_text(step.target)} was set"
            _fail(draft, job, step, Response(int(ControlResponse.PARAM_ERROR), b"", why, job.request.id))
    elif response.code == ControlResponse.NO_RESPONSE:
        why = f"not sent: a setting before it failed ({response.reason})"
        _answer_unsent(draft, job, replace(response, reason=why))
    else:
        _fail(draft, job, step, response)


# --- 2. decided, ordered and sent -------------------------------------------------------------------------------------


def _decided(draft: StateDraft, job: ForwardedRequest, turn: Turn, lending: Lending) -> Lending | None:
    compared = lending.compared or _compared_here(draft, turn, lending.stated)
    draft.limits = draft.limits.was_read(turn.values, draft.now_ns)
    of_kind = turn.values.get(names.SPEC_KIND)
    kind = (of_kind and of_kind.value) or ""
    draft.loans, changed = draft.loans.compared(compared, kind)
    for key, loan in changed.items():
        _found_changed(draft, key, loan, compared[loan.name].parameter)
    stated = _with_pair(draft, _stated(draft, job, kind), compared)
    if changed and stated[: len(lending.stated)] != lending.stated:  # a person's value takes the place of a stated one
        _begin(draft, job, turn)
        return None
    now = {name: one.parameter for name, one in compared.items()}
    if second_electrode := answers.refusal_for_second_electrode(job.request, now):
        _refuse(draft, job, second_electrode)
        return None
    lending = replace(lending, compared=compared, now=now, stated=stated, kind=kind, way=())
    way = list[WayStep]()
    for one in stated:
        found = compared.get(one.name)
        if found is None:
            why = f"the microscope has no parameter {one.name}"
            _refuse(draft, job, Response(int(ControlResponse.PARAM_NOT_SUPPORTED), b"", why, job.request.id))
            return None
        if beyond := draft.limits.beyond_range(one) if one not in found.known else "":  # before the first step to it
            _refuse(draft, job, Response(int(ControlResponse.PARAM_ERROR), b"", beyond, job.request.id))
            return None
        key = key_of(one.name, kind)
        lender = job.client if _is_loan(draft, found, key) else ""
        if one not in found.known:
            way.append(WayStep(key if lender else "", one, lender))
        elif lender:
            draft.loans = draft.loans.sending(key, found.parameter, found.parameter, lender, kind_of(one.name, kind))
    keys = {key_of(one.name, kind) for one in stated}
    back = [key for key in _due(draft, job, kind, compared) if key not in keys]
    there = [key for key in back if draft.loans.loans[key].base in compared[draft.loans.loans[key].name].known]
    draft.loans = draft.loans.gone(there)
    way += [WayStep(key, draft.loans.loans[key].base) for key in back if key not in there]
    if way and draft.microscope.risk.holds_z:
        why = f"z is held, so that {way[0].target.name} stays as it is: state it before z is held"
        _refuse(draft, job, Response(int(ControlResponse.PARAM_ERROR), b"", why, job.request.id))
        return None
    return replace(lending, way=_in_order(draft, lending, way))


def _due(draft: StateDraft, job: ForwardedRequest, kind: str, compared: Mapping[str, Setting]) -> list[str]:
    book, request = draft.loans, job.request
    if draft.control.mode is ControlMode.MANUAL or draft.microscope.risk.holds_z:
        return []
    if request.kind == RETURN_REQUEST:
        readable = dict(book.of_kind(kind))
        found = [key for key in book.over() if key in readable and not book.loans[key].why]
    elif request.kind == LEND_REQUEST:  # a start finds out about curves and treatments
        found = book.nothing_stated().due(names.START_SCAN, kind)
    else:
        found = book.due(str(request.subject), kind)
    for key in found:
        if book.loans[key].name not in compared:
            draft.loans = draft.loans.refused(key, "the microscope does not show it any more")
    return [key for key in found if book.loans[key].name in compared]


def _found_changed(draft: StateDraft, key: str, loan: Loan, now: Parameter) -> None:
    value, before = amount_text(now), amount_text(loan.base)
    draft.log(
        "WARNING",
        f"{loan.name} reads {value}, and not the {amount_text(loan.value)} that {loan.lender} has lent it: "
        f"{value} is its base from now on, where {before} was",
    )
    # half a way, or one without a watch, is no person's answer to the loan; nor is what may be the rounding of a
    # controller. No plan measures beyond the limits
    is_act = loan.is_watched and loan.before is None and draft.loans.is_compared
    if is_act and now.value is not None and not draft.limits.beyond_range(now):
        draft.plans, notes = draft.plans.decided(key, now, loan.lender, "at the microscope")
        draft.warn(notes)


def _with_pair(
    draft: StateDraft, stated: tuple[Parameter, ...], compared: Mapping[str, Setting]
) -> tuple[Parameter, ...]:
    # what lies between tip and sample is a difference: the second electrode is lent with the bias
    second = names.SAMPLE_BIAS
    given = {one.name for one in stated}
    if names.TIP_BIAS_VOLTAGE not in given or second in given or second not in compared:
        return stated
    loan = draft.loans.loans.get(second)
    present = compared[second].parameter
    return stated if present.value is None else (*stated, present if loan is None else loan.base)


def _is_loan(draft: StateDraft, found: Setting, key: str) -> bool:
    # in MANUAL a person decides
    if draft.control.mode is ControlMode.MANUAL or not may_be_lent(found):
        return False
    if key in draft.loans.loans:
        return True
    name = found.parameter.name
    if found.parameter.value is None:
        draft.log("WARNING", f"{name} can't be read, so that it stays as it is set for this measurement")
        return False
    return True


def _compared_here(draft: StateDraft, turn: Turn, stated: tuple[Parameter, ...]) -> dict[str, Setting]:
    # the translator answers no COMPARE: it is of another make
    found = dict[str, Setting]()
    for name, asked in _to_compare(draft, stated).items():
        if name in turn.values:
            there = turn.values[name] or Parameter(name)
            found[name] = Setting(there, tuple(one for one in asked.known if equal(one, there)))
    return found


def _in_order(draft: StateDraft, lending: Lending, way: list[WayStep]) -> tuple[WayStep, ...]:
    by_name = {step.target.name: step for step in way}
    ordered = [
        name for name, step in by_name.items()
        if _number(draft, step.target) is not None and _number(draft, lending.now.get(name)) is not None
    ]  # fmt: skip
    now = {name: _number(draft, lending.now[name]) for name in ordered}
    then = {name: _number(draft, by_name[name].target) for name in ordered}
    others = [step for step in way if step.target.name not in then]
    return (*others, *(by_name[name] for name in widening_first(now, then)))


def _number(draft: StateDraft, parameter: Parameter | None) -> float | None:
    return None if parameter is None else draft.limits.number(parameter)


def _sent_step(draft: StateDraft, job: ForwardedRequest, turn: Turn, lending: Lending) -> Lending | None:
    # returns the rest of the way after a setting that can't be set back for now; None: a step was sent, or refused
    assert lending.way
    step, name = lending.way[0], lending.way[0].target.name
    now = lending.now[name]
    wanted = draft.limits.next_step(now, step.target)
    loan = draft.loans.loans.get(step.key)
    is_back = not step.lender and loan is not None
    param = _as_param(job, wanted)
    client = loan.lender if loan is not None and is_back else job.client
    draft.pending = replace(draft.pending, turn=replace(turn, lending=lending))
    refusal = draft.limits.check(client, param, draft.now_ns) or draft.limits.check_forbidden(
        param, present_state.present_state(draft, turn.values)
    )
    if refusal is None and not is_back:
        refusal = approvals.refusal(draft, job._replace(request=param))
    if refusal is not None:
        return _fail(draft, job, step, refusal)
    if step.key:
        kind = kind_of(name, lending.kind)
        draft.loans = draft.loans.sending(step.key, now, wanted, step.lender, kind)
    draft.limits = draft.limits.sending(client, param, draft.now_ns)
    present_state.sending(draft, param)
    if not is_back:
        approvals.sending(draft, job._replace(request=param))
    ends = is_back and wanted == step.target
    purpose = SetForTurn(job.number, step.key, is_back=is_back, ends_loan=ends)
    draft.forwarder, _ = draft.forwarder.ask_own(replace(param, id=""), draft.now_s, purpose)
    waiting = replace(turn, awaited=frozenset({name}), lending=replace(lending, sent=wanted))
    draft.pending = replace(draft.pending, turn=waiting)
    return None


def _fail(draft: StateDraft, job: ForwardedRequest, step: WayStep, refusal: Response) -> Lending | None:
    # a step was refused: by a limit, or by the microscope
    loan, is_back = draft.loans.loans.get(step.key), not step.lender
    if step.target.name == names.SPEC_KIND:  # on the way back of a curve's settings
        for key in [key for key, one in draft.loans.loans.items() if one.kind == step.target.value]:
            draft.loans = draft.loans.refused(key, refusal.reason)
    if loan is None or not is_back:
        _refuse(draft, job, refusal)
        return None
    why = f"{loan.text}, can't be set back: {refusal.reason}"
    if refusal.again_ns is None:
        if loan.why != refusal.reason or job.request.kind == ControlRequest.ACTION:
            draft.log("WARNING", why)
        draft.loans = draft.loans.refused(step.key, refusal.reason)
    if job.request.kind == ControlRequest.ACTION:
        reason = f"{job.request.subject}: {why}; set it back at the panel, or by a request"
        code = int(ControlResponse.ACTION_ERROR)
        _refuse(draft, job, replace(refusal, code=code, reason=reason, id=job.request.id))
        return None
    if job.request.kind == LEND_REQUEST:
        _refuse(draft, job, replace(refusal, reason=why, id=job.request.id))
        return None
    turn = draft.pending.turn
    assert turn is not None
    assert turn.lending is not None
    assert turn.lending.way
    later = turn.lending.later if refusal.again_ns is None else replace(refusal, reason=why, id=job.request.id)
    rest = replace(turn.lending, way=turn.lending.way[1:], later=later)
    draft.pending = replace(draft.pending, turn=replace(turn, awaited=frozenset(), lending=rest))
    return rest


def _starts_other_kind(draft: StateDraft, job: ForwardedRequest, turn: Turn, lending: Lending) -> bool:
    # a RETURN also sets back the curves of other kinds, whose values can only be read and set in their own kind
    if job.request.kind != RETURN_REQUEST:
        return False
    book = draft.loans
    other = next((book.loans[key].kind for key in book.over() if not book.loans[key].why and book.loans[key].kind), "")
    before = lending.kind_before or lending.kind
    wanted = other if other and other != lending.kind else before
    if not wanted or wanted == lending.kind:
        return False
    way = (WayStep("", Parameter(names.SPEC_KIND, wanted)),)
    now = {**lending.now, names.SPEC_KIND: Parameter(names.SPEC_KIND, lending.kind)}
    again = Lending(kind_before=before, now=now, way=way, kind=wanted, later=lending.later)
    return _sent_step(draft, job, turn, again) is None and draft.pending.turn is not None


# --- 3. and 4. settled, and answered ----------------------------------------------------------------------------------


def _settle_s(draft: StateDraft, job: ForwardedRequest) -> float:
    given = job.request.subject.settle_s if isinstance(job.request.subject, Settings) else None
    return draft.env.settings.control.settle_s if given is None else float(given)


def _finish(draft: StateDraft, job: ForwardedRequest, lending: Lending) -> None:
    payload = b""
    if job.request.kind == LEND_REQUEST:
        stated, token = lending.stated, draft.peers.sessions.token(job.client)
        draft.loans = draft.loans.stating(job.client, token, {key_of(one.name, lending.kind): one for one in stated})
        draft.plans = draft.plans.stating(job.client, *_planned(draft, job, lending))
        if draft.control.solving:
            draft.plans = draft.plans.solving(draft.loans.stated)
        given = tuple(_answered(draft, job, lending, one) for one in _asked(job))
        payload = draft.env.codec.encode(Settings(given))
        if job.client == draft.control.holder:
            draft.lease = draft.lease.commanded(draft.now_ns, draft.now_s)
    elif job.request.kind == RETURN_REQUEST:
        _try_again_later(draft)
    draft.forwarder = draft.forwarder.without(job.number)
    draft.pending = replace(draft.pending, turn=None)
    if lending.later is not None and job.client != SCHEDULER:
        answers.answer_unsent(draft, job, lending.later)
    else:
        answers.finish(draft, job, Response(int(ControlResponse.SUCCESS), payload, "", job.request.id))


def _planned(
    draft: StateDraft, job: ForwardedRequest, lending: Lending
) -> tuple[dict[str, Parameter], tuple[str, ...]]:
    # the values whose place others may take, and the keys of swept ones; a person in MANUAL and a solver plan nothing
    if draft.control.mode is ControlMode.MANUAL or draft.control.solving:
        return {}, ()
    asked = [one for one in _asked(job) if one.parameter.name in lending.compared]
    lent = [one for one in asked if may_be_lent(lending.compared[one.parameter.name])]
    planned = {key_of(one.parameter.name, lending.kind): one.parameter for one in lent if not one.is_swept}
    return planned, tuple(key_of(one.parameter.name, lending.kind) for one in lent if one.is_swept)


def _answered(draft: StateDraft, job: ForwardedRequest, lending: Lending, asked: Setting) -> Setting:
    name = asked.parameter.name
    found, in_force = lending.compared.get(name), lending.now.get(name, asked.parameter)
    # of a value that is not lent, the client learns the one before
    shown: tuple[Parameter, ...] = (in_force,)
    if found is not None and not may_be_lent(found):
        shown = (in_force, found.parameter)
    if job.request.alias:
        shown = tuple(map(draft.env.settings.limits.bias.of_sample, shown))
    return Setting(shown[0], shown[1:], is_lent=False if shown[1:] else None)


def _try_again_later(draft: StateDraft) -> None:
    # a limit on time, or a controller that does not answer
    if is_to_return(draft.loans):
        draft.loans = replace(draft.loans, again_s=draft.now_s + _AGAIN_S)


def _refuse(draft: StateDraft, job: ForwardedRequest, refusal: Response) -> None:
    refusal = answers.with_alias(draft, job.request, refusal)
    answers.log_refusal(draft, job.client, refusal)
    _answer_unsent(draft, job, refusal)


def _answer_unsent(draft: StateDraft, job: ForwardedRequest, response: Response) -> None:
    if job.request.kind == RETURN_REQUEST:
        _try_again_later(draft)
    answers.take_off(draft, job, response)


def _asked(job: ForwardedRequest) -> tuple[Setting, ...]:
    subject = job.request.subject
    return subject.settings if job.request.kind == LEND_REQUEST and isinstance(subject, Settings) else ()


def _stated(draft: StateDraft, job: ForwardedRequest, kind: str) -> tuple[Parameter, ...]:
    # each with what takes its place: no point of a sweep has one, nor does a value that limits refuse by now
    found = []
    for one in _asked(job):
        value = draft.plans.instead(job.client, key_of(one.parameter.name, kind), one.parameter)
        is_allowed = value == one.parameter or not (one.is_swept or draft.limits.beyond_range(value))
        found.append(value if is_allowed else one.parameter)
    return tuple(found)


def _as_param(job: ForwardedRequest, parameter: Parameter) -> Request:
    return Request(int(ControlRequest.PARAM), parameter, id=job.request.id)


# --- decisions, and what takes the place of stated values -------------------------------------------------------------


def begun(draft: StateDraft, client: str) -> None:
    """Note that a measurement or treatment has begun, with what its client had stated for it."""
    if not draft.control.solving:
        bases = {key: loan.base for key, loan in draft.loans.loans.items() if key in draft.loans.stated}
        draft.plans = draft.plans.beginning(client, bases)
    draft.loans = draft.loans.nothing_stated()


def decided(draft: StateDraft, job: ForwardedRequest, answered: Parameter | None) -> None:
    """Note what a client has set outside of a measurement: a base, and of a person or solver more than that."""
    kind, names_set = draft.limits.kind_of_curve, draft.limits.names_set_by(job.outgoing)
    is_solver = bool(draft.control.solving) and job.client == draft.control.holder
    for asked in () if job.is_by_hand else _values_set(job.outgoing):
        value = asked if answered is None or answered.value is None or answered.name != asked.name else answered
        if is_solver:
            draft.plans = draft.plans.finding(key_of(asked.name, kind), asked, value)
        elif _is_person(draft, job.client):
            _overrule(draft, value, f"by {job.client}")
    draft.loans = draft.loans.decided(names_set, kind)


def turned(draft: StateDraft, value: Parameter) -> None:
    """Note a value that a person has set at the panel in AUTOMATED: the next look finds one that is lent."""
    if key_of(value.name, draft.limits.kind_of_curve) not in draft.loans.loans:
        _overrule(draft, value, "at the microscope")


def _overrule(draft: StateDraft, value: Parameter, by: str) -> None:
    key = key_of(value.name, draft.limits.kind_of_curve)
    loan = draft.loans.loans.get(key)
    if loan is None:
        draft.plans, notes = draft.plans.newer(key, value, by)
    else:
        draft.plans, notes = draft.plans.decided(key, value, loan.lender, by)
    draft.warn(notes)


def _is_person(draft: StateDraft, client: str) -> bool:
    # beside who is in control, the experiment file lets persons alone adjust anything
    return client != draft.control.holder and not draft.env.settings.rules.is_agent(client)


def _values_set(request: Request) -> tuple[Parameter, ...]:
    subject = request.subject
    if isinstance(subject, Parameter):
        return (subject,)
    return feedback_values(subject) if isinstance(subject, Feedback) else ()


def _left(draft: StateDraft) -> list[tuple[StatedValue, Overruling]]:
    if draft.control.mode is not ControlMode.MANUAL:
        return []
    left = draft.plans.left(draft.by_hand.left, draft.limits.kind_of_curve)
    return [(stated, one) for stated, one in left if not draft.limits.beyond_range(one.value)]


def refusal_to_overrule(draft: StateDraft, event: RequestIn) -> str:
    """Carry out a person's KEEP or AS_PLANNED; return why it is refused, empty if it is not."""
    who, kept = event.name, event.request.kind == KEEP_REQUEST
    if draft.env.settings.rules.is_agent(who) or draft.peers.supervisors.starts_of(who) is not None:
        return "a person decides what takes the place of a plan's values, and never a component or agent"
    given = [one.name for one in event.request.subject.parameters]
    if not kept:
        draft.plans = draft.plans.as_planned(given)
        draft.log("INFO", f"{who}: the plans measure with the values of their file again")
        return ""
    if draft.control.mode is not ControlMode.MANUAL:
        return "values are kept before the run continues: the mode is AUTOMATED"
    left = [(stated, one) for stated, one in _left(draft) if not given or stated.parameter.name in given]
    if not left:
        return "no plan would set another value than was set in MANUAL"
    draft.plans, notes = draft.plans.keeping(left, who)
    draft.warn(notes)
    return ""


# --- returns that no measurement waits for ----------------------------------------------------------------------------


def may_return(draft: StateDraft) -> bool:
    """Return whether settings may be set back now, with no other component at work."""
    control, tip = draft.control, draft.watchdog
    if control.mode is ControlMode.MANUAL or draft.barrier.until_s is not None or not draft.forwarder.up:
        return False
    if draft.microscope.risk.holds_z or not draft.microscope.is_free or tip.owes_retract or tip.left_to_people:
        return False
    if Problem.DEVICE_MALFUNCTION in control.problems:
        return False
    lenders = {loan.lender for loan in draft.loans.loans.values() if loan.is_over}
    return control.holder is None or bool(control.solving) or lenders == {control.holder}


def begin_returns(draft: StateDraft) -> None:
    """Queue a RETURN of the scheduler itself, once loans are over and may be set back."""
    book = draft.loans
    if not book.loans:
        return
    if draft.now_s >= book.again_s > 0.0:
        book = replace(book, again_s=0.0)
    for lender in {loan.lender for loan in book.loans.values() if not loan.is_over}:
        gone_s = draft.peers.dead_at_s(lender)
        if gone_s is not None and draft.now_s >= gone_s:
            book = book.returned_by(lender)
    idle_ns = return_due_ns(book, draft.env.settings.control.return_after_s)
    if (idle_ns is not None and draft.now_ns >= idle_ns) or draft.control.ended:
        book = book.ended(book.loans)
    draft.loans = book
    if not is_to_return(book) or book.again_s or draft.pending.turn is not None or not may_return(draft):
        return
    if any(job.request.kind == RETURN_REQUEST for job in draft.forwarder.queue):
        return
    request = Request(RETURN_REQUEST, Settings())
    job = ForwardedRequest(SCHEDULER, request, command=True, heard_s=draft.now_s)
    draft.forwarder, _ = draft.forwarder.ask(job, draft.now_s)


def is_to_return(book: LoanBook) -> bool:
    """Return whether loans are over that nothing is known against."""
    return any(loan.is_over and not loan.why for loan in book.loans.values())


def return_due_ns(book: LoanBook, after_s: float) -> int | None:
    """Return the experiment time at which the loans of a free microscope are over; None: it is busy, or has none."""
    is_lent = any(not loan.is_over for loan in book.loans.values())
    return None if book.free_since_ns is None or not is_lent else book.free_since_ns + round(after_s * 1e9)


def due_s(state: SchedulerState | StateDraft) -> float | None:
    """Return the real time at which a lender counts as gone, or a return is tried again; None: nothing is awaited."""
    book, peers = state.loans, state.peers
    lenders = {loan.lender for loan in book.loans.values() if not loan.is_over}
    dues = [at_s for at_s in map(peers.dead_at_s, lenders) if at_s is not None]
    if is_to_return(book) and book.again_s:
        dues.append(book.again_s)
    return min(dues, default=None)


def publish_changes(draft: StateDraft) -> None:
    """Publish the loans if they have changed, and no more changes are on their way."""
    turn, book = draft.pending.turn, draft.loans
    before = draft.before
    now = book.loans, turn, draft.plans, draft.by_hand, draft.control.mode
    then = before.loans.loans, before.pending.turn, before.plans, before.by_hand, before.control.mode
    if book.shown is not None and all(one is other for one, other in zip(now, then, strict=True)):
        return
    is_on_its_way = turn is not None and turn.lending is not None and not turn.lending.is_done
    if is_on_its_way or draft.barrier.until_s is not None:
        return
    shown = LoansInForce(book.in_force, (*draft.plans.in_force, *(one for _, one in _left(draft))))
    if shown == book.shown:
        return
    draft.loans = replace(book, shown=shown)
    publish(draft, LOANS.name, draft.env.codec.encode(shown))


def say_in_manual(draft: StateDraft) -> None:
    """Log what stays in force while a person has the microscope."""
    for loan in draft.loans.in_force:
        value, base = (draft.limits.number(one) for one in (loan.value, loan.base))
        is_small = loan.value.name == names.TIP_BIAS_VOLTAGE and value is not None and base is not None
        level = "CRITICAL" if is_small and abs(value or 0.0) < 0.1 * abs(base or 0.0) else "WARNING"
        draft.log(level, f"in force, and set back after `afspm continue` unless you set it: {loan.text}")
