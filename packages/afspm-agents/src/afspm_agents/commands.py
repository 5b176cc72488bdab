"""`afspm approve`: a person decides on agents' plans. `afspm agent`: serve the tools over stdin and stdout."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from afspm.basics import parse_toml
from afspm.cli import MEANWHILE, RUNS, Where, looking
from afspm.cli.joining import acting

if TYPE_CHECKING:
    from afspm.model import Grant, Proposal

NAME_VARIABLE = "AFSPM_AGENT"
"""Environment variable with name and token of an agent: NAME:TOKEN."""

approve_app = typer.Typer(rich_markup_mode=None, rich_help_panel=MEANWHILE)
agent_app = typer.Typer(rich_markup_mode=None, rich_help_panel=MEANWHILE)


@approve_app.command()
def approve(
    proposal: Annotated[str, typer.Argument(help="The id of a proposal; without one, all are listed.")] = "",
    where: Where = RUNS,
    grant: Annotated[
        Path | None, typer.Option(help="Give the grant in this TOML file.", exists=True, dir_okay=False)
    ] = None,
    revoke: Annotated[str, typer.Option(metavar="AGENT", help="End all approvals of an agent.")] = "",
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Don't ask.")] = False,
) -> None:
    """Approve a plan that an agent proposes, give an agent a grant, or revoke both.

    The command shows every request of the plan, or the bounds of the grant, before you confirm. The scheduler enforces
    the approval, and the limits of the experiment. An approval ends with MANUAL, with `--revoke`, or after its time: an
    hour for a plan.
    """
    from afspm.basics import InvalidValue
    from afspm.model import Grant
    from afspm_agents.approval import of_table

    if revoke:
        with acting(where) as scope:
            scope.approve(Grant(revoke))
        typer.echo(f"all approvals of {revoke} have ended")
        return
    if grant is not None:
        with acting(where) as scope:
            wanted = of_table(parse_toml(grant.read_text(encoding="utf-8")), scope.approval_facts())
            typer.echo("\n".join(grant_lines(wanted)))
            _confirm(yes)
            scope.approve(wanted)
        typer.echo(f"{wanted.agent} has the grant")
        return
    proposals = _proposals(where)
    if not proposal:
        for one in proposals:
            typer.echo(f"{one.id}  {one.who}  {_state(one)}  {_title(one)}")
        return
    found = next((one for one in proposals if one.id == proposal), None)
    if found is None:
        raise InvalidValue(f"there is no proposal {proposal}", hint="`afspm approve` lists them")
    _approve(where, found, yes=yes)


@agent_app.command()
def agent(url: Annotated[str, typer.Argument(help="Of the agent server, as its log line says it.")]) -> None:
    """Serve the tools of a running experiment over stdin and stdout, for clients that start their server themselves.

    Name and token of the agent are in the environment: AFSPM_AGENT=NAME:TOKEN.
    """
    import asyncio

    from afspm_agents.bridge import serve

    asyncio.run(serve(url, os.environ.get(NAME_VARIABLE, "")))


def grant_lines(grant: Grant) -> list[str]:
    """Return a grant as lines of text for people, with units."""
    from afspm.basics import area_text, duration_text, position_text, quantity
    from afspm.model import names

    region = grant.region
    where = "no place" if region is None else f"{area_text(region.size_m)} at {position_text(region.center_m)}"
    lines = [f"{grant.agent}, for {duration_text(grant.lasts_s)}", f"  place: {where}"]
    for one in grant.ranges:
        unit = names.BASE_PARAMETERS.get(one.parameter) or ""
        lines.append(f"  {one.parameter}: {quantity(one.low, unit)} to {quantity(one.high, unit)}")
    lines += [f"  {each.action}: {each.count} times" for each in grant.counts]
    return [*lines, "  nothing else"]


def _approve(where: Path, proposal: Proposal, *, yes: bool) -> None:
    import asyncio

    from afspm.basics import AfspmError, escaped
    from afspm.client import find_run
    from afspm.model import Frame, names
    from afspm_agents.approval import of_plan, summary
    from afspm_agents.simulated_run import repeated

    with acting(where) as scope:
        # requests have the same bytes in each frame
        grant, plan = of_plan(proposal, Frame.TIP, scope.approval_facts())
        typer.echo(f"{proposal.who} proposes, in its own words: {_title(proposal)}")
        for number, request in enumerate(plan.requests(Frame.TIP), 1):
            typer.echo(f"  {number}. {escaped(request.text)}")
        try:
            speed = scope.get(names.SCAN_SPEED)
        except AfspmError:
            speed = None  # this microscope has no such parameter
        speed_m_s = speed if isinstance(speed, float) else None
        found = repeated(plan, proposal.who, frame=Frame.TIP, run_dir=find_run(where), speed_m_s=speed_m_s)
        typer.echo(summary(asyncio.run(found)))
        _confirm(yes)
        scope.approve(grant)
    typer.echo(f"{proposal.id} is approved, for one run within an hour")


def _proposals(where: Path) -> list[Proposal]:
    with looking(where) as follower:
        return list(follower.overview.proposals.values())


def _state(proposal: Proposal) -> str:
    from afspm.basics import AfspmError
    from afspm_agents.plan import plan_of

    try:
        plan_of(proposal.plan)
    except AfspmError:
        return "can't be approved, its plan can't be read"
    return "has a preflight" if proposal.preflight else "has no preflight"


def _title(proposal: Proposal) -> str:
    from afspm.basics import escaped
    from afspm_agents.plan import title_of

    return f'"{escaped(title_of(proposal.plan))}"'


def _confirm(yes: bool) -> None:
    if not yes:
        typer.confirm("Approve?", abort=True)
