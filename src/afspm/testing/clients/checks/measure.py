"""Checks of measurements and settings through a real scheduler and the simulated microscope."""

from __future__ import annotations

from collections.abc import Sequence

from afspm.basics.plain_data import Plain
from afspm.basics.units import si
from afspm.testing.clients.bench import ClientBench
from afspm.testing.clients.checks.launch import require_beats
from afspm.testing.clients.client_suite import client_check
from afspm.testing.clients.experiment import JudgedExperiment
from afspm.testing.clients.facts import compare
from afspm.testing.clients.program import Answer
from afspm.testing.conformance import Failed, expect, near

SCAN_S = 120.0
CHANNELS = 2
"""The smallest number of channels of the simulated microscope."""


def scan_step(shape: Sequence[int] = (16, 32), angle_deg: float = 0.0, timeout_s: float = SCAN_S) -> Plain:
    """Return the arguments of a small scan."""
    return {
        "center_m": [0.2e-6, -0.1e-6],
        "size_m": [1e-6, 0.5e-6],
        "angle_deg": angle_deg,
        "shape": list(shape),
        "timeout_s": timeout_s,
    }


def require_scans(experiment: JudgedExperiment, answer: Answer, asked: Plain) -> None:
    """Raise Failed unless an answer contains the published channels of the requested scan."""
    expect(answer.ok, "the scan to be taken", str(answer))
    scans = answer.get("scans")
    if not isinstance(scans, list):
        raise Failed("scans, a list", str(answer))
    channels = {str(scan.get("channel")) for scan in scans}
    expect(len(channels) == len(scans) >= CHANNELS, "each channel once", f"{[scan.get('channel') for scan in scans]}")
    for scan in scans:
        _require_published(experiment, "Scan2d", scan)
        expect(scan["shape"] == asked["shape"], f"a scan of the shape {asked['shape']}", f"{scan['shape']}")
        for name in ("center_m", "size_m"):
            right = all(near(a, b, 1e-3, 1e-10) for a, b in zip(scan[name], asked[name], strict=True))
            expect(right, f"a scan with {name} = {asked[name]}", f"{scan[name]}")
        expect(near(scan["angle_deg"], asked["angle_deg"], 1e-3, 1e-3), f"{asked['angle_deg']}°", scan["angle_deg"])


def _require_published(experiment: JudgedExperiment, message: str, reported: dict[str, object]) -> None:
    # a client need not report which packet was its own measurement, so the fields are compared
    reported = {"message": message, **reported}
    wrong: list[Failed] = []

    def is_there() -> bool:
        wrong.clear()
        for packet in experiment.packets(message):
            of_packet = {"envelope": packet.envelope, "timestamp_ns": packet.time_ns}
            if any(reported.get(name, value) not in (value, None) for name, value in of_packet.items()):
                continue
            try:
                compare({**reported, **of_packet}, packet)
            except Failed as failure:
                wrong.append(failure)
            else:
                return True
        return False

    if not experiment.pump(is_there, 5.0):
        raise wrong[-1] if wrong else Failed(f"a {message} that was published", str(reported))


@client_check(
    "measure/parameters",
    "Parameters are read, and set with units.",
    "Send value and unit as text; answer what the response's `ParameterMsg` says.",
)
def parameters(bench: ClientBench) -> None:
    experiment = bench.experiment
    with bench.client(experiment) as client:
        program = client.program
        _require_value(program.succeed("get_parameter", name="scan-speed"), "scan-speed", "4 um/s")
        program.succeed("request_control", problem=0, timeout_s=10.0)
        for value, unit in (("300", "mV"), ("0.25", "V"), ("-0.5", None)):
            answer = program.succeed("set_parameter", name="tip-bias-voltage", value=value, unit=unit)
            _require_value(answer, "tip-bias-voltage", f"{value} {unit or 'V'}")
            there = float(experiment.scope.get("tip-bias-voltage"))
            right = si(f"{value} {unit or 'V'}", "V")
            expect(near(there, right), f"{right} V at the microscope", f"{there} V")
        program.succeed("release_control")


def _require_value(answer: Answer, name: str, right: str) -> None:
    text = f"{answer.get('value')} {answer.get('unit') or ''}".strip()
    dimension = right.split()[1].removeprefix("m") if "/" not in right else "m/s"
    try:
        came = si(text, dimension)
    except Exception as error:  # the answer is a client's and may be anything: any error means a wrong answer
        raise Failed(f"{name} = {right}", f"{answer} ({error})") from error
    expect(near(came, si(right, dimension)), f"{name} = {right}", str(answer))


@client_check(
    "measure/scan",
    "A scan gives all channels of the frame that was asked for, with the values that were published.",
    "Set the frame, wait for `SS_FREE`, start, collect `Scan2d` until `SS_FREE`.",
)
def scan(bench: ClientBench) -> None:
    experiment = bench.experiment
    with bench.client(experiment) as client:
        for asked in (scan_step(), scan_step((8, 8), 30.0), scan_step((8, 8), 30.0)):
            answer = client.program.do("scan", **asked)
            require_scans(experiment, answer, asked)
            expect(answer.get("interruptions") == 0, "no interruption", str(answer.get("interruptions")))
        free = experiment.pump(lambda: experiment.scope.control_state.holder is None, 5.0)
        expect(free, "control given back after the scan", "a client that keeps it")
        client.program.succeed("request_control", problem=0, timeout_s=10.0)
        require_scans(experiment, client.program.do("scan", **scan_step()), scan_step())
        held = client.program.succeed("state").get("in_control")
        expect(held is True, "control kept after a scan, if it was there before", "a client that has given it back")
        client.program.succeed("release_control")


@client_check(
    "measure/spectrum",
    "A spectrum is taken where it was asked for.",
    "Set `x-spec-kind` and the position, wait for `SS_FREE`, `start-spec`, collect `Spec1d`.",
)
def spectrum(bench: ClientBench) -> None:
    experiment = bench.experiment
    with bench.client(experiment) as client:
        for position in ([0.1e-6, 0.2e-6], [-0.3e-6, 0.0]):
            answer = client.program.do("spectrum", position_m=position, kind="IV", timeout_s=SCAN_S)
            expect(answer.ok and answer.get("spectra"), "a spectrum", str(answer))
            for reported in answer["spectra"]:
                _require_published(experiment, "Spec1d", reported)
                came = reported["position_m"]
                right = all(near(a, b, 1e-3, 1e-10) for a, b in zip(came, position, strict=True))
                expect(
                    right and reported["kind"] == "IV", f"an IV curve at {position}", f"{reported['kind']} at {came}"
                )


@client_check(
    "measure/large-scan",
    "A scan of 2048 × 2048 arrives, and heartbeats go on meanwhile.",
    "Do not copy value by value; do not beat in the thread that decodes.",
)
def large_scan(bench: ClientBench) -> str:
    experiment = bench.experiment
    asked = scan_step((2048, 2048))
    experiment.scope.set("scan-speed", "1 mm/s")
    try:
        with bench.client(experiment, envelopes=("ScopeStateMsg",)) as client:
            since_s = bench.clock.monotonic_s()
            answer = client.program.do("scan", **asked)
            require_beats(client.beats, since_s)
            require_scans(experiment, answer, asked)
    finally:
        experiment.scope.set("scan-speed", "4 um/s")
    views = {scan.get("view") for scan in answer["scans"]}
    words = {True: "are read where they were received", False: "were copied"}
    return f"the client says that values {words[views.pop()]}" if views <= {True} or views <= {False} else ""
