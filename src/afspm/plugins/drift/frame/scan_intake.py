"""Processing of a scan, from its first packet to its publication in sample coordinates.

| step | trigger | action |
| --- | --- | --- |
| hold | the first channel of the scan arrives | the scan and all later packets wait in the gate |
| register | the channel for drift arrives | the worker gets a job |
| settle | report of the worker, error, or time limit | the mapping of the scan is announced, and saved with the state |
| release | directly after settling | the waiting packets are processed again, in their order |
| respond | a later step, after the publication | problems are flagged, rescans requested |
"""

from __future__ import annotations

import dataclasses
import math

from afspm.basics import AfspmError, Plain, lengths_text, replace
from afspm.model import (
    ChannelRoles,
    Frame,
    Packet,
    PacketHeader,
    Region,
    RegistrationOutcome,
    Scan,
    ScanParameters,
    ScopeState,
    ScopeStatus,
)
from afspm.plugins.drift.frame import response
from afspm.plugins.drift.frame.messages import (
    DriftCodec,
    Forecasted,
    Matrix,
    NotRegistered,
    Registered,
    ScanJob,
    StartWorker,
    WorkerGone,
    WorkerReport,
)
from afspm.plugins.drift.frame.positions import is_same
from afspm.plugins.drift.frame.state import (
    CallPerson,
    DriftDraft,
    FollowUp,
    HeldScan,
    RespondToFailure,
    RespondToScan,
)
from afspm.plugins.drift.track.mapping import Mapping
from afspm.scheduler import Announced, Delegate, HoldControl, PacketIn, Reconsider, SaveNow

MAPPING = "DriftMapping"
_HOW = {
    RegistrationOutcome.COARSE: "is registered coarsely",
    RegistrationOutcome.REFUSED: "is not recognised, and published at the predicted position",
    RegistrationOutcome.FAILED: "could not be registered, and is published at the predicted position",
    RegistrationOutcome.NEW: "shows a new place, and is published at the predicted position",
}
_LEVELS = {
    RegistrationOutcome.COARSE: "WARNING",
    RegistrationOutcome.REFUSED: "WARNING",
    RegistrationOutcome.FAILED: "ERROR",
    RegistrationOutcome.NEW: "INFO",
}
_MOST_TRIES = 2
"""Largest number of jobs for one scan, if the worker ends during each."""
_MOST_ENDS = 4
"""Number of ends of the worker without a report about a scan, after which the worker is not restarted."""


# --- packets ----------------------------------------------------------------------------------------------------------


def take_packet(draft: DriftDraft, event: PacketIn) -> None:
    """Pass a packet on, or hold the packet until the current scan is released.

    A late or repeated channel of a settled scan passes with the mapping of that scan.
    """
    _note_roles(draft, event)
    if (before := draft.gate.held) is not None:
        draft.gate = draft.gate.keep(event)
        _find_channel(draft, before, event)
        return
    message, packet = event.header.message, event.packet
    note_timing(draft, message, packet.payload, packet.time_ns)
    scan = draft.env.codec.decode_packet(message, packet.payload) if message == "Scan2d" else None
    if not isinstance(scan, Scan) or not scan.values.size:
        draft.outputs.append(event)
        return
    key = scan_key(scan, packet)
    if key in draft.gate.settled:
        draft.outputs.append(_relocated(event, scan, draft.gate.settled[key], draft.env.codec))
        return
    until_s = draft.now_s + draft.env.settings.longest_registration
    held = HeldScan(key, _middle_s(draft, scan, event), until_s, scan.filename, scan.region.center_m)
    draft.timing = draft.timing.after(scan, _published_ns(event, draft.now_ns), draft.places.upwards)
    draft.gate = replace(draft.gate, held=held).keep(event)
    draft.outputs.append(HoldControl(until_s))
    _find_channel(draft, held, event)


def _note_roles(draft: DriftDraft, event: PacketIn) -> None:
    if event.header.message == "ChannelRoles":
        roles = draft.env.codec.decode_packet(event.header.message, event.packet.payload)
        if isinstance(roles, ChannelRoles):
            draft.gate = replace(draft.gate, roles=roles)


def _find_channel(draft: DriftDraft, held: HeldScan, event: PacketIn) -> None:
    # a state other than SCANNING ends a scan that has no channel to register
    if held.asked:
        return
    if draft.worker.ends >= _MOST_ENDS:  # a person was called, or has chosen to go on
        publish_as_predicted(draft, held, "drift is no longer followed", "WARNING")
        return
    message, codec = event.header.message, draft.env.codec
    if message == "ScopeStateMsg":
        status = codec.decode_packet(message, event.packet.payload)
        if isinstance(status, ScopeStatus) and status.state is not ScopeState.SCANNING:
            _give_up(draft, held.key, f"{draft.gate.lacking()}: it can't be used for drift", "WARNING")
    elif message == "Scan2d":
        scan = codec.decode_packet(message, event.packet.payload)
        if not isinstance(scan, Scan) or not scan.values.size or scan_key(scan, event.packet) != held.key:
            return
        draft.gate = draft.gate.with_channel_of(scan)
        if scan.channel == draft.gate.channel:
            _register(draft, held, scan, event)


def _register(draft: DriftDraft, held: HeldScan, scan: Scan, event: PacketIn) -> None:
    end_s = _end_s(scan, event, draft.now_ns)
    start_s, upwards = 2 * held.middle_s - end_s, None
    begun = draft.timing.of_scan(scan, _published_ns(event, draft.now_ns))
    # a scan that was broken off shows neither how long such a scan takes, nor when its middle row was taken
    if begun is not None and not begun.was_paused and not scan.lines_missing:
        upwards = begun.upwards
        durations = draft.places.durations.learn(scan.shape, scan.region.size_m, end_s - start_s)
        draft.places = replace(draft.places, durations=durations)
    _ask_worker(draft, held, ScanJob(held.key, scan, start_s, end_s, upwards, _requested_region(draft, scan)))


def _ask_worker(draft: DriftDraft, held: HeldScan, job: ScanJob) -> None:
    draft.gate = replace(draft.gate, held=replace(held, asked=True, tries=held.tries + 1))
    draft.worker = replace(draft.worker, job=job)
    draft.outputs.append(Delegate(job))


def _requested_region(draft: DriftDraft, scan: Scan) -> Region | None:
    # unknown if the scan was taken elsewhere than the scheduler had set it
    place = draft.places.region.current
    if place is None or not is_same(place.tip, scan.region):
        return None
    return dataclasses.replace(place.sample, frame=Frame.SAMPLE)


def _middle_s(draft: DriftDraft, scan: Scan, event: PacketIn) -> float:
    # from the scan's own end, so that a late file causes no error
    expected_s = draft.places.durations.expected_s(scan.shape, scan.region.size_m)
    end_s, begun = _end_s(scan, event, draft.now_ns), draft.timing.of_scan(scan, _published_ns(event, draft.now_ns))
    return end_s - expected_s / 2 if begun is None else (begun.time_s + end_s) / 2


def note_timing(draft: DriftDraft, message: str, payload: bytes | memoryview, time_ns: int | None) -> None:
    """Track the start of scans from a published scope state, or from the conditions before a scan."""
    if message in ("ScopeStateMsg", "MeasurementConditions") and time_ns is not None:
        thing = draft.env.codec.decode_packet(message, payload)
        draft.timing = draft.timing.after(thing, time_ns, draft.places.upwards)


# --- reports of the worker --------------------------------------------------------------------------------------------


def take_report(draft: DriftDraft, report: WorkerReport) -> None:
    match report:
        case Registered():
            _registered(draft, report)
        case NotRegistered():
            draft.worker = replace(draft.worker, ends=0)
            _give_up(draft, report.key, report.reason)
        case WorkerGone():
            _worker_gone(draft, report)
        case Forecasted():
            _take_forecast(draft, report.forecast)


def _registered(draft: DriftDraft, report: Registered) -> None:
    draft.worker = replace(draft.worker, ends=0)
    _take_forecast(draft, report.forecast)
    held, job = draft.gate.held, draft.worker.job
    is_awaited = held is not None and held.key == report.key
    if held is not None and is_awaited:
        corrects = draft.forecast.corrects(draft.env.settings, report.time_s)
        draft.gate = draft.gate.settle(report.key, report.matrix if corrects else None)
        _log_if_slow(draft, held)
    if job is None or job.key != report.key:
        return  # a restarted worker repeats its last report
    draft.worker = replace(draft.worker, job=None)
    draft.forecast = replace(draft.forecast, lost=report.lost)
    before_ns = draft.gate.next_ns() if is_awaited else None
    _announce(draft, report, job.scan.filename, job.scan.region.center_m, before_ns)
    _log_outcome(draft, report, job.scan.filename)
    if is_awaited:
        _release(draft)
    _respond_later(draft, RespondToScan(report, job))
    response.hand_over(draft)


def _worker_gone(draft: DriftDraft, report: WorkerGone) -> None:
    ends = draft.worker.ends + 1
    draft.worker = replace(draft.worker, ends=ends)
    held, job = draft.gate.held, draft.worker.job
    if ends >= _MOST_ENDS:
        draft.log("CRITICAL", f"drift is no longer followed: {report.reason}")
        _respond_later(draft, CallPerson())
        if held is not None:
            publish_as_predicted(draft, held, report.reason)
        return
    draft.log("ERROR", f"the process that registers scans ended and is restarted: {report.reason}")
    draft.outputs.append(Delegate(StartWorker()))
    if held is None or not held.asked:
        return
    if job is None or job.key != held.key or held.tries >= _MOST_TRIES:
        _give_up(draft, held.key, report.reason)
    else:
        _ask_worker(draft, held, job)


def expire(draft: DriftDraft) -> None:
    """Publish a scan that has waited too long as predicted, and restart a worker that hangs."""
    held = draft.gate.held
    if held is None or draft.now_s < held.until_s:
        return
    if held.asked:
        draft.worker = replace(draft.worker, job=None)
        draft.outputs.append(Delegate(StartWorker()))
    _give_up(draft, held.key, f"it was not registered within {draft.env.settings.longest_registration:g} s")


def restart_if_cleared(draft: DriftDraft) -> None:
    """Restart the worker once a person has cleared device-malfunction."""
    if draft.worker.waits_for_person and not response.is_given_up(draft):
        draft.worker = replace(draft.worker, waits_for_person=False, ends=0)
        draft.outputs.append(Delegate(StartWorker()))


def _take_forecast(draft: DriftDraft, forecast: Plain | None) -> None:
    try:
        draft.forecast = draft.forecast.learn(forecast)
    except AfspmError as error:
        draft.log("ERROR", f"the drift forecast can't be read: {error}")


def _log_if_slow(draft: DriftDraft, held: HeldScan) -> None:
    # once, and early: with more references a registration takes several times as long
    limit_s = draft.env.settings.longest_registration
    took_s = draft.now_s - (held.until_s - limit_s)
    if draft.worker.slow_logged or took_s < limit_s / 3:
        return
    draft.worker = replace(draft.worker, slow_logged=True)
    text = f"registering a scan took {took_s:.1f} s; above longest_registration = {limit_s:g} s it is given up"
    draft.log("WARNING", f"{text}: use fewer pixels, or raise longest_registration")


# --- publication ------------------------------------------------------------------------------------------------------


def _give_up(draft: DriftDraft, key: str, why: str, level: str = "") -> None:
    # counted as a failure: after several of them the prediction is not reliable
    held = draft.gate.held
    if held is not None and held.key == key:
        _respond_later(draft, RespondToFailure(why))
        publish_as_predicted(draft, held, why, level)


def publish_as_predicted(draft: DriftDraft, held: HeldScan, why: str, level: str = "") -> None:
    """Publish an unregistered scan at its predicted place, without correction at its place in tip coordinates."""
    mapping = draft.forecast.mapping_at(draft.env.settings, held.middle_s)
    draft.gate = draft.gate.settle(held.key, None if mapping is None else mapping.matrix.tolist())
    report = _predicted(draft, held, why)
    draft.worker = replace(draft.worker, job=None)  # a late report would announce the scan once more
    _announce(draft, report, held.filename, held.center_m, draft.gate.next_ns())
    _log_outcome(draft, report, held.filename, level)
    _release(draft)


def _announce(
    draft: DriftDraft, report: Registered, filename: str, center_m: tuple[float, float], before_ns: int | None
) -> None:
    draft.tally = draft.tally.add(report.outcome)
    # at the middle of the scan, as the scan itself is published
    corrects = draft.forecast.corrects(draft.env.settings, report.time_s)
    payload = draft.env.codec.encode_mapping(
        report, filename, center_m, correcting=corrects, channel=draft.gate.channel
    )
    draft.outputs.append(Announced(MAPPING, payload, before_ns))


def _log_outcome(draft: DriftDraft, report: Registered, filename: str, level: str = "") -> None:
    for failure in report.failures:
        draft.log("ERROR", failure)
    if report.outcome is not RegistrationOutcome.REGISTERED:
        how = _HOW[report.outcome]
        sd = "unknown" if math.isnan(report.sd_m) else f"± {lengths_text([float(f'{report.sd_m:.2g}')])}"
        name = filename.replace("\\", "/").rpartition("/")[2] or report.key
        why = "" if report.failures else f": {report.reason}"  # an error is logged already
        text = f"scan {name} {how} ({sd}){why}; {draft.tally.summary()}"
        draft.log(level or _LEVELS[report.outcome], text)


def _release(draft: DriftDraft) -> None:
    # saved first: a scan published again after a kill must have the same mapping
    draft.outputs += (SaveNow(), *map(Reconsider, draft.gate.waiting))
    draft.gate = draft.gate.opened()


def _respond_later(draft: DriftDraft, what: FollowUp) -> None:
    # in a step of its own, since a response may change which client is in control
    draft.following = (*draft.following, (draft.now_s, what))


def _predicted(draft: DriftDraft, held: HeldScan, why: str) -> Registered:
    there = draft.forecast.predicted(held.middle_s)
    known = None if there is None else (there.covariance_m2, there.rate_m_s, there.rate_covariance)
    covariance_m2, rate_m_s, rate_covariance = ([], [], []) if known is None else (one.tolist() for one in known)
    return Registered(
        key=held.key,
        time_s=held.middle_s,
        matrix=(Mapping.identity() if there is None else there.mapping).matrix.tolist(),
        covariance_m2=covariance_m2,
        rate_m_s=rate_m_s,
        rate_covariance=rate_covariance,
        outcome=RegistrationOutcome.FAILED,
        lost=draft.forecast.lost,
        reason=why,
        residual_m=[],
        references=[],
        rescan="",
        forecast=None,
        failures=[],
    )


def scan_key(scan: Scan, packet: Packet) -> str:
    """Return a key shared by all channels of a scan, and unique to this scan."""
    if scan.time_ns is None and scan.filename:
        return scan.filename
    return f"at {packet.time_ns if scan.time_ns is None else scan.time_ns} ns"


def _published_ns(event: PacketIn, now_ns: int) -> int:
    return now_ns if event.packet.time_ns is None else event.packet.time_ns


def _end_s(scan: Scan, event: PacketIn, now_ns: int) -> float:
    return (_published_ns(event, now_ns) if scan.time_ns is None else scan.time_ns) * 1e-9


def _relocated(event: PacketIn, scan: Scan, matrix: Matrix | None, codec: DriftCodec) -> PacketIn:
    if matrix is None:
        return event
    region = Mapping(matrix).to_sample(scan.region)  # type: ignore[arg-type]
    packet, header = event.packet, event.header
    payload = codec.relocated("Scan2d", packet.payload, codec.encode(ScanParameters(region)))
    size_m = region.size_m if header.size_m is not None else None
    moved = PacketHeader(header.message, header.channel, size_m, header.kind, header.time_ns)
    return PacketIn(Packet(packet.envelope, payload, packet.time_ns), moved)
