"""The expected end of a running experiment, from its plans and the progress that its components report."""

from __future__ import annotations

from collections.abc import Mapping

from afspm.basics.clock import NS_PER_S
from afspm.basics.plain_data import PlainMapping
from afspm.model import Progress
from afspm.model.planned_work import PlannedWork, planned_end_s
from afspm.record.run_json import PLANNED

Plans = Mapping[str, PlannedWork | None]


def plans_of(facts: PlainMapping) -> dict[str, PlannedWork | None]:
    """Return the plans in run.json, by component; None: a plan without estimate."""
    return {name: data and PlannedWork.from_dict(data) for name, data in (facts.get(PLANNED) or {}).items()}


def expected_end_ns(plans: Plans, reports: Mapping[str, Progress], began_ns: int | None, now_ns: int) -> int | None:
    """Return the experiment time of the end, never before `now_ns`; None if unknown.

    The end follows from the reported progress of each component; before its first report, from its plan.

    Args:
        reports: newest progress of each component.
        began_ns: start of the experiment; None if unknown.
    """
    left = [_left(plans[name], reports.get(name), began_ns, now_ns) for name in plans]
    end_s = planned_end_s(left)
    return None if end_s is None else now_ns + round(end_s * NS_PER_S)


def _left(plan: PlannedWork | None, report: Progress | None, began_ns: int | None, now_ns: int) -> PlannedWork:
    ends_experiment = plan is not None and plan.ends_experiment
    return PlannedWork(duration_s=_left_s(plan, report, began_ns, now_ns), ends_experiment=ends_experiment)


def _left_s(plan: PlannedWork | None, report: Progress | None, began_ns: int | None, now_ns: int) -> float | None:
    if report is not None and report.of > 0:
        left_ns = 0 if report.done >= report.of else report.remaining_ns(now_ns)
        return None if left_ns is None else left_ns / NS_PER_S
    if plan is None or plan.end_s is None or began_ns is None:
        return None
    left_s = plan.end_s - (now_ns - began_ns) / NS_PER_S
    return left_s if left_s > 0.0 else None  # later than planned without a report: the plan is void
