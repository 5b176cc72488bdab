"""Responses to a registered scan: problem flags, rescans, and a drift rate for the controller."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from afspm.basics import replace
from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlResponse,
    Parameter,
    Problem,
    Request,
    RescanKind,
    Response,
    ScanParameters,
    names,
)
from afspm.plugins.drift.frame.messages import Compensated, RescanWanted, ScanJob
from afspm.plugins.drift.frame.positions import is_same
from afspm.plugins.drift.frame.state import CallPerson, DriftDraft, FollowUp, RespondToFailure, RespondToScan
from afspm.plugins.drift.frame.tally import LATELY
from afspm.scheduler import Announced, AskMicroscope, Delegate, ProblemSeen

RESCAN = "DriftRescan"
_DRIFT, _MALFUNCTION = int(Problem.THERMAL_DRIFT), int(Problem.DEVICE_MALFUNCTION)
_MOST_UNREGISTERED = 3
"""Number of unprocessed scans in a row that counts as a lost sample; trackers have the same default."""
_AT_START = "a scan in the other direction gives the velocity of the drift"


def respond(draft: DriftDraft, what: FollowUp) -> None:
    """Carry out a deferred response: to a report on a scan, an abandoned registration, or the worker's last end."""
    match what:
        case RespondToScan():
            _respond_to_scan(draft, what)
        case RespondToFailure():
            _respond_to_failure(draft, what.why)
        case CallPerson():
            _call_person(draft)


def is_given_up(draft: DriftDraft) -> bool:
    """Return whether device-malfunction is flagged, for example because the worker ended repeatedly."""
    return _MALFUNCTION in draft.control.problems


def _respond_to_scan(draft: DriftDraft, what: RespondToScan) -> None:
    registered = what.registered
    draft.duties = replace(draft.duties, unregistered=0)
    if not draft.corrects:
        # until correction begins, there is time to measure the velocity
        draft.duties = replace(draft.duties, started=True)
    elif draft.control.mode is ControlMode.MANUAL:
        # a person's scan is followed, but no rescan requested
        if registered.matched and not registered.lost:
            _clear_own_flag(draft)
    elif registered.lost:
        _search(draft, f"the sample is lost: {registered.reason}", what.job)
    elif not draft.duties.started and not what.job.scan.lines_missing:
        _scan_in_opposite_direction(draft, what.job)
    elif draft.tally.exceeds(draft.env.settings.most_unregistered):
        _respond_to_low_share(draft)
    else:
        if registered.matched:
            _clear_own_flag(draft)
        if registered.rescan:
            _request_rescan(draft, RescanKind.AGAIN, registered.rescan, what.job)


def _respond_to_failure(draft: DriftDraft, why: str) -> None:
    if not draft.corrects or draft.control.mode is ControlMode.MANUAL:
        return
    unregistered = draft.duties.unregistered + 1
    if unregistered < _MOST_UNREGISTERED:
        draft.duties = replace(draft.duties, unregistered=unregistered)
        if draft.tally.exceeds(draft.env.settings.most_unregistered):
            _respond_to_low_share(draft)
        return
    # if a component clears the flag, it is flagged again after the same number
    draft.duties = replace(draft.duties, unregistered=0)
    draft.tally = draft.tally.share_restarted()
    _search(draft, f"{_MOST_UNREGISTERED} scans in a row could not be registered: {why}")


def _call_person(draft: DriftDraft) -> None:
    # without correction the worker's end delays no component
    if not draft.env.settings.correct:
        return
    draft.worker = replace(draft.worker, waits_for_person=True)
    draft.outputs.append(ProblemSeen(_MALFUNCTION, flagged=True, name=draft.env.name))


def _respond_to_low_share(draft: DriftDraft) -> None:
    draft.tally = draft.tally.share_restarted()
    share = f"more than {draft.env.settings.most_unregistered:.0%} of the last {LATELY} scans were not registered"
    _search(draft, f"{share}: {draft.tally.summary()}")


def _search(draft: DriftDraft, why: str, job: ScanJob | None = None) -> None:
    draft.outputs.append(ProblemSeen(_DRIFT, flagged=True, name=draft.env.name))
    # a searching component has widened the region itself: a request for that region would be wrong
    if draft.control.solving != _DRIFT:
        _request_rescan(draft, RescanKind.SEARCH, why, job)


def _scan_in_opposite_direction(draft: DriftDraft, job: ScanJob) -> None:
    # flagged, so that no component scans before both directions are there
    draft.duties = replace(draft.duties, started=True)
    if job.upwards is None:
        why = f"the microscope does not report {names.SCAN_DIRECTION}"
        draft.log("INFO", f"{why}: the first scan is not taken in both directions")
        return
    draft.log("INFO", "thermal-drift is flagged until the first scan was taken in both directions: normal at the start")
    draft.outputs.append(ProblemSeen(_DRIFT, flagged=True, name=draft.env.name))
    _request_rescan(draft, RescanKind.OPPOSITE, _AT_START, job, upwards=not job.upwards)


def _clear_own_flag(draft: DriftDraft) -> None:
    # a component that solves the problem restores its own changes first
    control = draft.control
    if control.problems.get(_DRIFT) == draft.env.name and control.solving != _DRIFT:
        draft.outputs.append(ProblemSeen(_DRIFT, flagged=False, name=draft.env.name))


def _request_rescan(
    draft: DriftDraft, kind: RescanKind, reason: str, job: ScanJob | None, *, upwards: bool | None = None
) -> None:
    place, shape = draft.places.region.current, draft.places.shape
    requested = None if place is None else place.requested
    if job is not None and job.asked is not None and (place is None or not is_same(place.sample, job.asked)):
        # another region was set while the scan waited for its registration
        requested, shape = draft.env.codec.encode(ScanParameters(job.asked)), job.scan.shape
    if requested is None:
        draft.log("ERROR", f"{reason}, and the region to scan again is unknown")
        return
    wanted = RescanWanted(kind, requested, shape, reason, draft.now_ns, upwards)
    level = "INFO" if kind is RescanKind.OPPOSITE else "WARNING"  # it belongs to the start of every night
    draft.log(level, f"requesting a rescan: {reason}")
    draft.outputs.append(Announced(RESCAN, draft.env.codec.encode_rescan(wanted)))


# --- a controller that compensates by itself --------------------------------------------------------------------------


@dataclass(frozen=True)
class RateGiven:
    """A request to the controller to compensate `value_m_s` along an axis.

    Attributes:
        is_new: whether the worker must take the rate into account from now on.
    """

    axis: int
    name: str
    value_m_s: float
    is_new: bool


def restore_compensation(draft: DriftDraft) -> None:
    """Set the controller to the compensation in force, initially zero; an earlier night may have left another rate."""
    for axis, name in enumerate(_axes(draft)):
        _ask_rate(draft, RateGiven(axis, name, draft.duties.given_m_s[axis], is_new=False))


def hand_over(draft: DriftDraft) -> None:
    """Add the newest drift rate to the rate that the controller compensates, unless a person is in control.

    Only a rate above its standard deviation is sent, and only while drift is corrected.
    """
    predicted = draft.forecast.predicted(draft.now_ns * 1e-9)
    if draft.control.mode is ControlMode.MANUAL or predicted is None or not draft.corrects:
        return
    sd_m_s = np.sqrt(np.diagonal(predicted.rate_covariance))
    if np.hypot(*predicted.rate_m_s) <= np.hypot(*sd_m_s):
        return
    for axis, name in enumerate(_axes(draft)):
        value_m_s = float(draft.duties.given_m_s[axis] + predicted.rate_m_s[axis])
        _ask_rate(draft, RateGiven(axis, name, value_m_s, is_new=True))


def rate_answered(draft: DriftDraft, given: RateGiven, response: Response) -> None:
    """Process the controller's answer for one axis; the controller may accept one axis and refuse the other."""
    if not response.ok:
        # NOT_FREE: a scan has already begun; the rate is handed over after the next one
        if response.code != ControlResponse.NOT_FREE:
            draft.log("ERROR", f"the drift rate {given.name} was refused: {response.reason}")
        return
    if not given.is_new:
        return
    x_m_s, y_m_s = draft.duties.given_m_s
    now_given = (given.value_m_s, y_m_s) if given.axis == 0 else (x_m_s, given.value_m_s)
    draft.duties = replace(draft.duties, given_m_s=now_given)
    draft.outputs.append(Delegate(Compensated(draft.now_ns * 1e-9, now_given)))


def _axes(draft: DriftDraft) -> tuple[str, ...]:
    compensate = draft.env.settings.compensate
    return () if compensate is None else (compensate.x, compensate.y)


def _ask_rate(draft: DriftDraft, given: RateGiven) -> None:
    parameter = Parameter(given.name, f"{given.value_m_s:.9g}", "m/s")
    request = Request(int(ControlRequest.PARAM), parameter, draft.env.codec.encode(parameter))
    draft.outputs.append(AskMicroscope(request, given))
