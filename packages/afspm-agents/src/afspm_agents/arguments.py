"""Arguments of the tools, validated strictly: nothing is converted or dropped silently.

The high-level server of the MCP library converts "0.5" and `true` to numbers, and drops unknown arguments: a model that
misspells `size` would scan the region in force. Hence the low-level server, and one strict model for each tool.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from afspm_agents.plan import LONGEST_TITLE, MOST_PIXELS, MOST_STEPS

LARGEST_PX = 512
"""Largest number of rows or columns of a picture; more would only cost tokens."""
ProposalId = Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
ScanId = Annotated[str, Field(pattern=r"^([0-9]{1,20}|newest)$", description="an id of `scans`, or newest")]
Quantity = Annotated[str, Field(min_length=1, max_length=40)]
Place = Annotated[list[Quantity], Field(min_length=2, max_length=2, description='x, y: ["10 nm", "0 nm"]')]
Pixels = Annotated[int, Field(ge=1, le=MOST_PIXELS)]
Count = Annotated[int, Field(ge=1, le=50)]


class Arguments(BaseModel):
    """Base of the arguments of all tools."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Nothing(Arguments):
    """Arguments of a tool without arguments."""


class Newest(Arguments):
    """Number of entries to return; the newest is the last."""

    count: Count = 20


class Journal(Newest):
    """Number of journal entries to return, optionally only entries after a given entry."""

    since: Annotated[str, Field(pattern=r"^[0-9]{0,20}$", description="id of an entry")] = ""


class OfScan(Arguments):
    """Id of a scan."""

    scan: ScanId


class Picture(OfScan):
    """Channel of a scan, and size of its picture."""

    channel: Annotated[int, Field(ge=0, le=63, description="index in the list of channels")] = 0
    px: Annotated[int, Field(ge=16, le=LARGEST_PX)] = 256


class DoScan(Arguments):
    """Step of a plan: take a scan."""

    do: Literal["scan"]
    center: Place
    size: Place
    pixels: Annotated[list[Pixels], Field(min_length=2, max_length=2, description="rows, columns")]
    angle: Quantity = "0 deg"


class DoSpectrum(Arguments):
    """Step of a plan: take a spectrum at a place."""

    do: Literal["spectrum"]
    at: Place


class DoSet(Arguments):
    """Step of a plan: set a parameter."""

    do: Literal["set"]
    parameter: Annotated[str, Field(min_length=1, max_length=100)]
    value: Annotated[str, Field(min_length=1, max_length=100, description='with its unit: "2 um/s"')]


class DoMove(Arguments):
    """Step of a plan: move the probe."""

    do: Literal["move"]
    to: Place


Step = Annotated[DoScan | DoSpectrum | DoSet | DoMove, Field(discriminator="do")]


class PlanArguments(Arguments):
    """Title and steps of a plan, in order."""

    title: Annotated[str, Field(min_length=1, max_length=LONGEST_TITLE)]
    steps: Annotated[list[Step], Field(min_length=1, max_length=MOST_STEPS)]


class Propose(Arguments):
    """Plan to propose."""

    plan: PlanArguments


class OfProposal(Arguments):
    """Id of a proposal."""

    proposal: ProposalId


class Measure(Arguments):
    """Step to carry out within a grant."""

    step: Step


def _cut(given: object) -> str:
    return str(given)[:200]


class Stop(Arguments):
    """Reason for stopping the experiment; a stop is never refused for its arguments."""

    model_config = ConfigDict(extra="ignore")

    reason: Annotated[str, BeforeValidator(_cut), Field(description="for the person, up to 200 characters")] = ""
