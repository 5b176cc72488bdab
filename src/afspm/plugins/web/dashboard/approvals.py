"""Plans that agents propose, and approvals in force: a person approves or revokes them here."""

from __future__ import annotations

import json
from functools import partial
from html import escape

from nicegui import background_tasks, ui

from afspm.basics.errors import AfspmError
from afspm.basics.formatting import day_and_time
from afspm.model import Approval, Frame, Grant, Proposal
from afspm.model.events import PERSON
from afspm.plugins.agent.approval import of_plan, simulated
from afspm.plugins.agent.untrusted import escaped
from afspm.plugins.web.dashboard.actions import ActionResult
from afspm.plugins.web.dashboard.steering_session import SteeringSession, ask_in_dialog, button

MOST_SHOWN = 5


class ApprovalBar:
    """A line for each proposal with a preflight, newest last, and for each approval in force."""

    def __init__(self, session: SteeringSession) -> None:
        self._session = session
        self._shown: tuple[object, ...] = ()
        self._box = ui.element("div").classes("problems approvals").props('role="status"')
        self._box.set_visibility(False)

    def show(self) -> None:
        with self._session.watch.reading() as overview:
            approvals = overview.approvals.approvals
            approved = {one.plan for one in approvals}
            ready = [one for one in overview.proposals.values() if one.preflight and one.id not in approved]
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
        with ui.element("div").classes("flag"):
            ui.label(in_force(approval))
            if self._session.may_steer:
                button("Revoke", partial(self._revoke, approval.agent))

    def _add_proposal(self, proposal: Proposal) -> None:
        with ui.element("div").classes("flag"):
            ui.label(f"{proposal.who} proposes {proposal.id}: “{title(proposal)}”")
            if self._session.may_steer:
                button("Review", partial(self._review, proposal))

    def _revoke(self, agent: str) -> None:
        self._session.do(lambda a: a.approve(Grant(agent)))

    def _review(self, proposal: Proposal) -> None:
        background_tasks.create(self._decide(proposal))

    async def _decide(self, proposal: Proposal) -> None:
        with self._box:
            try:
                grant, lines = reviewed(proposal)
            except AfspmError as error:
                self._session.say(ActionResult(str(error), ok=False))
                return

            def body() -> None:
                items = "".join(f"<li>{escape(one)}</li>" for one in lines)
                ui.html(f"<ol>{items}</ol>", sanitize=False)
                ui.label(simulated(proposal))

            if await ask_in_dialog(f"Let {proposal.who} do exactly this, once?", body, "Approve"):
                self._session.do(lambda a: a.approve(grant))


def in_force(approval: Approval) -> str:
    """Return an approval in words."""
    left = ", ".join(f"{one.action}: {one.count}" for one in approval.left) or "no action"
    what = (
        f"may carry out plan {approval.plan}, {approval.steps_left} requests left"
        if approval.plan
        else f"may measure by itself, left: {left}"
    )
    until = day_and_time(approval.until_ns, seconds=False)
    return f"{approval.agent} {what}; approved by {approval.by.partition(PERSON)[2] or approval.by} until {until}"


def title(proposal: Proposal) -> str:
    """Return the agent's own words for its plan, escaped."""
    try:
        return escaped(str(json.loads(proposal.plan)["title"]))
    except (ValueError, KeyError, TypeError):
        return ""


def reviewed(proposal: Proposal) -> tuple[Grant, list[str]]:
    """Return the approval of a proposal, and each request in words. Raises AfspmError: it can't be approved."""
    # requests have the same bytes in each frame
    grant, plan = of_plan(proposal, Frame.TIP)
    return grant, [escaped(one.text) for one in plan.requests(Frame.TIP)]
