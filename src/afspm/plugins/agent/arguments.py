"""The arguments of the tools: strict, so that nothing is converted or dropped silently."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from afspm.plugins.agent.plan import LONGEST_TITLE, MOST_PIXELS, MOST_STEPS

LARGEST_PX = 512
"""Rows and columns of a picture; more would only cost tokens."""
ProposalId = Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
ScanId = Annotated[str, Field(pattern=r"^([0-9]{1,20}|newest)$", description="an id of `scans`, or newest")]
Quantity = Annotated[str, Field(min_length=1, max_length=40)]
Place = Annotated[list[Quantity], Field(min_length=2, max_length=2, description='x, y: ["10 nm", "0 nm"]')]
Pixels = Annotated[int, Field(ge=1, le=MOST_PIXELS)]
Count = Annotated[int, Field(ge=1, le=50)]


class Arguments(BaseModel):
    """Arguments of a tool."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Nothing(Arguments):
    """No arguments."""


class Newest(Arguments):
    """How many, newest last."""

    count: Count = 20


class Journal(Newest):
    """Entries after a time."""

    since: Annotated[str, Field(pattern=r"^[0-9]{0,20}$", description="id of an entry")] = ""


class OfScan(Arguments):
    """One scan."""

    scan: ScanId


class Picture(OfScan):
    """A picture of one scan."""

    channel: Annotated[int, Field(ge=0, le=63, description="index in the list of channels")] = 0
    px: Annotated[int, Field(ge=16, le=LARGEST_PX)] = 256


class ScanStep(Arguments):
    """Take a scan."""

    do: Literal["scan"]
    center: Place
    size: Place
    pixels: Annotated[list[Pixels], Field(min_length=2, max_length=2, description="rows, columns")]
    angle: Quantity = "0 deg"


class SpectrumStep(Arguments):
    """Take a spectrum at a place."""

    do: Literal["spectrum"]
    at: Place


class SetStep(Arguments):
    """Set a parameter."""

    do: Literal["set"]
    parameter: Annotated[str, Field(min_length=1, max_length=100)]
    value: Annotated[str, Field(min_length=1, max_length=100, description='with its unit: "2 um/s"')]


class MoveStep(Arguments):
    """Move the probe."""

    do: Literal["move"]
    to: Place


Step = Annotated[ScanStep | SpectrumStep | SetStep | MoveStep, Field(discriminator="do")]


class PlanArguments(Arguments):
    """Steps in their order."""

    title: Annotated[str, Field(min_length=1, max_length=LONGEST_TITLE)]
    steps: Annotated[list[Step], Field(min_length=1, max_length=MOST_STEPS)]


class Propose(Arguments):
    """A plan."""

    plan: PlanArguments


class OfProposal(Arguments):
    """One proposal."""

    proposal: ProposalId


class Measure(Arguments):
    """One step."""

    step: Step


class Stop(Arguments):
    """Why."""

    reason: Annotated[str, Field(min_length=1, max_length=200)]
