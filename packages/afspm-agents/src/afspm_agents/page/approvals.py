"""Plans that agents propose, and present approvals, which a person approves or revokes here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from html import escape

from nicegui import background_tasks, ui

from afspm.basics import AfspmError, Plain, counted, day_and_time, escaped, quantity, typeset_area, typeset_position
from afspm.model import PERSON, Approval, Frame, Grant, Proposal, names
from afspm.plugins.web.dashboard.actions import ActionResult, Actions
from afspm.plugins.web.dashboard.steering_session import SteeringSession, ask_in_dialog, button
from afspm_agents.approval import of_plan, of_table, simulated, summary
from afspm_agents.plan import Plan, plan_of, title_of
from afspm_agents.simulated_run import repeated

MOST_SHOWN = 5
STEPS_SHOWN = 3


class ApprovalBar:
    """A line for each present approval, and for the newest proposals that wait for one, newest last."""

    def __init__(self, session: SteeringSession) -> None:
        self._session = session
        self._shown: tuple[object, ...] = ()
        self._facts: Plain = {}
        self._speed_m_s: float | None = None
        self._box = ui.element("div").classes("problems approvals").props('role="status"')
        self._box.set_visibility(False)

    def show(self) -> None:
        with self._session.watch.reading() as overview:
            approvals, ready = overview.approvals.approvals, overview.waiting
        shown = (tuple(ready[-MOST_SHOWN:]), approvals, self._session.may_steer)
        if shown == self._shown:
            return
        self._shown = shown
        self._box.set_visibility(bool(ready or approvals))
        self._box.clear()
        with self._box:
            for approval in approvals:
                self._add_approval(approval)
            for proposal in ready[-MOST_SHOWN:]:
                self._add_proposal(proposal)

    def _add_approval(self, approval: Approval) -> None:
        with ui.element("div").classes("flag approval"):
            ui.html(_line_html(*in_force(approval)), sanitize=False)
            if self._session.may_steer:
                self._button("Revoke", approval.agent, partial(self._revoke, approval.agent))

    def _add_proposal(self, proposal: Proposal) -> None:
        with ui.element("div").classes("flag waits"):
            ui.html(_line_html(*waiting(proposal)), sanitize=False)
            if self._session.may_steer:
                self._button("Review", proposal.id, partial(self._review, proposal))

    def _button(self, text: str, what: str, on_click: Callable[[], object]) -> None:
        # as text of properties a name could set others
        button(text, on_click).props["aria-label"] = f"{text} {what}"

    def _revoke(self, agent: str) -> None:
        self._session.do(lambda a: a.approve(Grant(agent)))

    def _review(self, proposal: Proposal) -> None:
        background_tasks.create(self._decide(proposal))

    async def _decide(self, proposal: Proposal) -> None:
        with self._box:
            looked = await self._session.carry_out(self._look)
            if not looked.ok:
                self._session.say(looked)
                return
            try:
                grant, plan = of_plan(proposal, Frame.TIP, self._facts)
            except AfspmError as error:
                self._session.say(ActionResult(str(error), ok=False))
                return
            ui.notify("Simulating the plan …", position="bottom-right", classes="toast done")
            found = await repeated(
                plan, proposal.who, frame=Frame.TIP, run_dir=self._session.run_dir, speed_m_s=self._speed_m_s
            )
            lines = in_words(plan)

            def body() -> None:
                items = "".join(f"<li>{escape(one)}</li>" for one in lines)
                ui.html(f"<ol>{items}</ol>", sanitize=False)
                ui.label(summary(found))

            if await ask_in_dialog(f"Let {proposal.who} do exactly this, once?", body, "Approve"):
                self._session.do(lambda a: a.approve(grant))

    def _look(self, actions: Actions) -> ActionResult:
        # what happens from here on makes the approval stale
        self._facts, self._speed_m_s = actions.approval_facts(), actions.scan_speed_m_s()
        return ActionResult("")


def in_force(approval: Approval) -> tuple[str, str, str]:
    """Return (agent, its permissions, details) of a present approval."""
    by, until = approval.by.partition(PERSON)[2] or approval.by, day_and_time(approval.until_ns, seconds=False)
    end = f"approved by {by} until {until}"
    if approval.plan:
        return approval.agent, f"may carry out plan {approval.plan}: {approval.steps_left} requests left", end
    total = {one.action: one.count for one in approval.counts}
    used = [
        f"{one.action}: {total[one.action] - one.count} of {total[one.action]} used"
        if one.action in total
        else f"{one.action}: {one.count} left"
        for one in approval.left
    ]
    region = approval.region
    where = "at no place" if region is None else f"{typeset_area(region.size_m)} at {typeset_position(region.center_m)}"
    ranges = [
        f"{one.parameter} {quantity(one.low, unit)} to {quantity(one.high, unit)}"
        for one in approval.ranges
        for unit in (names.BASE_PARAMETERS.get(one.parameter) or "",)
    ]
    what = f"may measure by itself, {', '.join(used) or 'no action'}"
    return approval.agent, what, "; ".join([where, *ranges, end])


def waiting(proposal: Proposal) -> tuple[str, str, str]:
    """Return (agent, its plan in one line, the result of its own preflight) of a pending proposal."""
    try:
        plan = plan_of(proposal.plan)
    except AfspmError as error:
        return proposal.who, f"proposes {proposal.id}", str(error)
    steps = [escaped(one.text) for one in plan.requests(Frame.TIP)]
    more = f" and {counted(len(steps) - STEPS_SHOWN, 'more request')}" if len(steps) > STEPS_SHOWN else ""
    line = "; ".join(steps[:STEPS_SHOWN]) + more
    return (
        proposal.who,
        f"waits for your approval: “{title(proposal)}”: {line}",
        f"Its own preflight: {simulated(proposal)}",
    )


def _line_html(agent: str, what: str, details: str) -> str:
    return f'<b>{escape(agent)}</b> {escape(what)}<span class="advice">{escape(details)}</span>'


def grant_of(table: Mapping[str, object], facts: Plain) -> Grant:
    """Return a grant from the table that `afspm approve --grant` reads. Raises the errors of `of_table`."""
    return of_table(table, facts)


def title(proposal: Proposal) -> str:
    """Return the plan's title, escaped; empty if the plan has none."""
    return escaped(title_of(proposal.plan))


def in_words(plan: Plan) -> list[str]:
    """Return each request of a plan in words."""
    # requests have the same bytes in each frame
    return [escaped(one.text) for one in plan.requests(Frame.TIP)]
