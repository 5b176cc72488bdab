"""The plan of a ready-made component, as far as it is fixed before it runs: made once, never started."""

from __future__ import annotations

from dataclasses import dataclass, replace

from afspm.errors import AfspmError
from afspm.experiment.toml_lines import Table
from afspm.logic.limit_checker import LimitChecker
from afspm.logic.limits import ExperimentLimits
from afspm.model import ControlRequest, ProbePosition, Region, Request, ScanParameters

PURE = (
    "afspm.components",
    "afspm.emulators",
    "afspm.scheduler",
    *(f"afspm.microscopes.{one}" for one in ("asylum", "gxsm", "image", "nanonis", "nanosurf", "park", "simulator")),
)
"""Classes from here, and those derived from them, do nothing in `__init__` but to keep and to check their settings."""


@dataclass(frozen=True)
class PlannedMeasurements:
    """The measurements of a plan, and what the microscope must have for them.

    Attributes:
        drift_doubts: what to warn of where drift is corrected; `where` names the setting.
    """

    regions: tuple[Region, ...] = ()
    positions: tuple[tuple[float, float], ...] = ()
    shape: tuple[int, int] | None = None
    needs_actions: tuple[str, ...] = ()
    needs_parameters: tuple[str, ...] = ()
    drift_doubts: tuple[AfspmError, ...] = ()


def plan_of(component: type, settings: Table) -> PlannedMeasurements | None:
    """Return the plan of a component with these settings; None where it has none, or none that can be known.

    Raises:
        AfspmError: the component refuses its settings.
    """
    if not any(f"{base.__module__}.".startswith(f"{package}.") for base in component.__mro__ for package in PURE):
        return None
    made = component(**settings)
    if callable(check := getattr(made, "check", None)):
        check()  # what takes longer than `__init__` may
    plan = getattr(made, "plan", None)
    regions = tuple(r for r in getattr(plan, "regions", ()) if isinstance(r, Region))
    positions = tuple(getattr(made, "positions", ()))
    said = (tuple(getattr(made, name, ())) for name in ("needs_actions", "needs_parameters", "drift_doubts"))
    return PlannedMeasurements(regions, positions, getattr(plan, "shape", None), *said)


def refusals(name: str, planned: PlannedMeasurements, limits: ExperimentLimits) -> list[str]:
    """Return why the limits would refuse what is planned; each reason once."""
    # steps and rates depend on what is in force by then
    guard = LimitChecker(_without_changes(limits))
    wanted: list[tuple[ControlRequest, object]] = [
        (ControlRequest.SET_SCAN_PARAMS, ScanParameters(region, planned.shape)) for region in planned.regions
    ]
    wanted += [(ControlRequest.SET_PROBE_POS, ProbePosition(xy)) for xy in planned.positions]
    reasons = []
    for kind, subject in wanted:
        refused = guard.check(name, Request(kind, subject, b""), 0)
        if refused is not None:
            reasons.append(refused.reason)
    return list(dict.fromkeys(reasons))


def refused_actions(limits: ExperimentLimits) -> list[tuple[str, str]]:
    """Return the actions whose settings the limits would always refuse, and why."""
    parameters = {name: replace(limit, only=None) for name, limit in _without_changes(limits).parameters.items()}
    guard = LimitChecker(
        replace(limits, parameters=parameters, actions={}, region=None)
    )  # where the tip is is not known yet
    found = []
    for action in limits.sets:
        refused = guard.check("", Request(ControlRequest.ACTION, action, b""), 0)
        if refused is not None:
            found.append((action, refused.reason))
    return found


def _without_changes(limits: ExperimentLimits) -> ExperimentLimits:
    parameters = {
        name: replace(limit, step=None, rate_per_s=None, interval_s=None) for name, limit in limits.parameters.items()
    }
    return replace(limits, parameters=parameters)
