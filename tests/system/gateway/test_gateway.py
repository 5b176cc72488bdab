"""A program that speaks only HTTP takes part in an experiment."""

from __future__ import annotations

import base64
import io
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from http.client import HTTPConnection
from itertools import pairwise
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest
from deadlines import DEADLINE_S
from tests.system.gateway.gateway_lab import EXPERIMENT, REGION, SERIES, Client, Event, GatewayRun

import afspm
from afspm.plugins.web.gateway.reading_routes import FRESH_S
from afspm.plugins.web.gateway.stream import MOST_STREAMS
from afspm.plugins.web.passwords import hashed

Started = Callable[..., GatewayRun]


def test_a_night_by_http_alone_is_in_the_record_under_its_name(started: Started) -> None:
    run = started('\n[limits.actions.start-spec]\nevery = "1 h"\n')
    ada, looker = run.client("ada"), run.client()
    assert looker.get("/state")["microscope"]["state"] == "FREE"
    speed = looker.get("/parameters/scan-speed")
    assert (speed["value"], speed["unit"]) == (pytest.approx(2e-6), "m/s")
    assert {one["name"] for one in looker.get("/parameters")} > {"scan-speed", "tip-bias-voltage", "x-feedback-on"}
    assert {one["name"] for one in looker.get("/actions")} > {"stop-scan", "x-retract"}

    for path in ("/state", "/events"):  # faults 15; the second has no end
        head = looker.ask("HEAD", path)
        assert (head.status, head.body) == (200, b"")
    assert int(looker.ask("HEAD", "/state").headers["content-length"]) > 100
    assert looker.ask("HEAD", "/scans/no-such").status == 422
    assert looker.ask("HEAD", "/nowhere").status == 404
    assert looker.ask("DELETE", "/state").headers["allow"] == "HEAD, GET"
    assert looker.ask("POST", "/control", {}).code == "name-needed"
    assert ada.ask("POST", "/scans", {"region": REGION}).code == "not-in-control"
    assert ada.done("POST", "/control", {"lease_s": 30}) == {"holder": "gateway:ada", "lease_s": 30}
    refused = run.client("max").ask("POST", "/control", {})
    assert (refused.status, refused.code) == (409, "already-under-control")
    assert "gateway:ada" in refused.body["reason"]

    assert ada.done("PUT", "/parameters/tip-bias-voltage", {"value": "500 mV"})["value"] == pytest.approx(0.5)
    over = ada.ask("PUT", "/parameters/tip-bias-voltage", {"value": 4.0})
    assert (over.status, over.code) == (409, "parameter-refused")
    far = ada.ask("POST", "/scans", {"region": {**REGION, "center_m": [1e-5, 0]}})
    assert (far.status, far.code) == (409, "parameter-refused")
    assert ada.ask("PUT", "/parameters/no-such", {"value": 1}).code == "not-supported"
    assert ada.ask("POST", "/actions/x-no-such").code == "not-supported"

    begun = ada.ask("POST", "/scans", {"region": REGION, "shape": [16, 24], "key": "first"})
    assert (begun.status, begun.headers["location"]) == (202, "measurements/first")
    done = ada.until_measured("first")
    assert done["state"] == "done"
    assert ada.done("POST", "/scans", {"region": REGION, "shape": [16, 24], "key": "first"}) == done
    assert ada.ask("POST", "/scans", {"region": REGION, "key": "first"}).code == "key-used"
    scan = looker.get(f"/scans/{done['result']}")
    assert scan == looker.get("/scans/newest")
    assert (scan["shape"], scan["holder"], scan["region"]["size_m"]) == ([16, 24], "gateway:ada", [1e-6, 1e-6])
    values = np.load(io.BytesIO(looker.get("/scans/newest/values?channel=Height")))
    told = looker.get("/scans/newest/values?channel=Height&format=base64")
    again = np.frombuffer(base64.b64decode(told["base64"]), told["dtype"]).reshape(told["shape"])
    assert values.shape == (16, 24)
    assert np.array_equal(values, again)
    assert looker.get("/scans/newest/values?format=png").startswith(b"\x89PNG")
    assert looker.ask("GET", "/scans/newest/values?channel=None").code == "not-found"
    kept = [looker.ask("GET", f"/scans/{one}/values").headers["cache-control"] for one in ("newest", scan["id"])]
    assert kept == ["no-store", "private, max-age=3600"], "a browser must not show an earlier scan as the newest"

    ada.done("POST", "/spectra", {"position_m": [1e-7, 0], "key": "curve"})
    curve = ada.until_measured("curve")
    told = looker.get(f"/spectra/{curve['result']}")
    assert told["position_m"] == pytest.approx([1e-7, 0.0], abs=2e-8)
    assert np.load(io.BytesIO(looker.get("/spectra/newest/values"))).shape[1] == len(told["variables"])
    assert told["variables"][0]["role"] == "bias"
    soon = ada.ask("POST", "/spectra", {"key": "soon"})  # contributors K1
    assert (soon.status, soon.code) == (429, "too-soon")
    assert soon.body["again"] > looker.get("/state")["time"]
    assert 1 <= int(soon.headers["retry-after"]) <= 3600

    ada.done("PUT", "/problems/tip-shape-changed")
    assert {"name": "tip-shape-changed", "flagged": True} in looker.get("/problems")
    lost = ada.ask("POST", "/scans", {"key": "second"})
    assert lost.code == "not-in-control"
    ada.done("DELETE", "/problems/tip-shape-changed")
    ada.done("POST", "/notes", {"text": "the light was on", "scan": done["result"]})
    ada.done("PUT", "/mode", {"mode": "MANUAL"})
    assert ada.ask("POST", "/control", {}).code == "wrong-mode"
    ada.done("PUT", "/mode", {"mode": "AUTOMATED"})
    ada.done("POST", "/end")
    assert run.process.wait(DEADLINE_S) == 0

    with afspm.open_run(run.folder) as record:
        assert {row.holder for row in record.scans} == {"gateway:ada"}
        assert [note.text for note in record.notes] == ["the light was on"]
        keys = [entry.key for entry in record.journal if entry.key and entry.response == 0]
        assert keys == ["first", "curve"]
        assert {entry.who for entry in record.refusals} == {"gateway:ada"}


WRONG_SETTINGS = [
    ([], 422, "invalid"),
    ({"no name": 1}, 422, "invalid"),
    ({"tip-bias-voltage": None}, 422, "invalid"),
    ({"tip-bias-voltage": "0.5 nm"}, 409, "parameter-refused"),
    ({"tip-bias-voltage": "4 V"}, 409, "parameter-refused"),
    ({"scan-top-left-x": 0}, 409, "parameter-refused"),
    ({"x-no-such": 1}, 404, "not-supported"),
]


def test_settings_hold_for_their_measurement_alone(started: Started) -> None:
    run = started('\n[limits.actions.start-spec]\nevery = "1 h"\n')
    ada = run.client("ada")

    def measure(what: str, key: str, settings: dict[str, object] | None = None) -> None:
        asked = {"region": REGION, "shape": [16, 16]} if what == "scans" else {}
        ada.done("POST", f"/{what}", {**asked, "key": key, "settings": settings})
        assert ada.until_measured(key)["state"] == "done"

    ada.done("POST", "/control", {"lease_s": 60})
    before = ada.get("/parameters/tip-bias-voltage")["value"]
    for wrong, status, code in WRONG_SETTINGS:
        refused = ada.ask("POST", "/scans", {"settings": wrong, "key": "low"})
        assert (refused.status, refused.code) == (status, code), refused.body
    measure("scans", "low", {"tip-bias-voltage": "0.5 V", "scan-speed": 4e-6})
    assert ada.ask("POST", "/scans", {"settings": {"tip-bias-voltage": 0.6}, "key": "low"}).code == "key-used"
    measure("scans", "base")
    measure("spectra", "curve", {"tip-bias-voltage": 0.7})
    assert ada.ask("POST", "/spectra", {"settings": {"tip-bias-voltage": 0.8}, "key": "soon"}).code == "too-soon"
    measure("scans", "plain")  # what was stated for the refused curve holds no more
    measure("scans", "last", {"tip-bias-voltage": 0.9})
    ada.done("DELETE", "/control")
    time.sleep(FRESH_S)
    assert ada.get("/parameters/tip-bias-voltage")["value"] == pytest.approx(before)
    ada.done("POST", "/end")
    assert run.process.wait(DEADLINE_S) == 0
    with afspm.open_run(run.folder) as record:
        rows = (*record.scans, *record.spectra)
        in_force = {row.key: next(one.begin for one in row.in_force if one.name == "tip-bias-voltage") for row in rows}
    assert in_force == pytest.approx({"low": 0.5, "base": before, "curve": 0.7, "plain": before, "last": 0.9})


LEASE_S = 10.0
"""Real seconds: long enough that a busy computer renews in time."""


def test_a_client_that_vanishes_in_a_scan_loses_control_and_the_scan_is_stopped(started: Started) -> None:
    run = started(SERIES.format(every="10 min", scans=3), speed=60.0)
    ada = run.client("ada")
    ada.done("POST", "/control?wait_s=20", {"lease_s": LEASE_S})
    ada.done("PUT", "/parameters/scan-speed", {"value": "100 nm/s"})
    ada.done("POST", "/scans", {"region": REGION, "shape": [128, 128], "key": "long"})
    begun_s = time.monotonic()
    while time.monotonic() < begun_s + 1.2 * LEASE_S:
        assert run.client("ada").ask("PUT", "/control", {"lease_s": LEASE_S}).status == 200
        time.sleep(0.5)  # as a client does that renews its lease
    run.wait_for("gateway:ada")
    lost = next(one for one in ada.events("/events?kinds=control") if one.data["data"]["holder"] != "gateway:ada")
    assert lost.data["data"]["holder"] in (None, "series")
    failed = ada.until_measured("long")
    assert (failed["state"], failed["refusal"]["code"]) == ("failed", "interrupted")
    assert ada.ask("PUT", "/control", {}).code == "not-in-control"


def test_a_killed_gateway_continues_its_scans_and_its_clients_their_events(started: Started) -> None:
    run = started('[control]\ngrace = "60 s"\n', speed=20.0)
    ada = run.client("ada")
    ada.done("POST", "/control", {"lease_s": 60})
    asked = {"region": REGION, "shape": [32, 32], "key": "survives"}
    seen: list[Event] = []
    reader = threading.Thread(target=lambda: seen.extend(ada.events("/events?after=0")))
    reader.start()
    ada.done("POST", "/scans", asked)
    os.kill(run.pid("gateway"), signal.SIGKILL)
    reader.join(DEADLINE_S)
    run.wait_for("the gateway is at ", count=2)
    assert run.said("the gateway is at ")[1].endswith(run.url), "clients find it where it was"
    ada.done("PUT", "/control", {"lease_s": 60})
    assert ada.until_measured("survives")["state"] == "done"
    assert ada.done("POST", "/scans", asked)["state"] == "done"
    assert len(ada.get("/scans")) == 1
    for event in ada.events("/events", last=seen[-1].id):
        seen.append(event)
        if event.kind == "scan":
            break
    ids = [int(event.id) for event in seen]
    assert all(a < b for a, b in pairwise(ids)), "none twice"
    assert "missed" not in {event.kind for event in seen}
    states = [event.data["data"]["state"] for event in seen if event.kind == "state"]
    assert "SCANNING" in states
    ada.done("POST", "/end")


def test_spectra_from_before_a_restart_are_served_from_the_record(started: Started) -> None:
    run = started("[cache]\nhistory = { Spec1d = 1 }\n")  # of which the scheduler would replay only the last
    run.wait_up("recorder", 1)  # as would be all that it gets, if it joined after the third curve
    ada = run.client("ada")
    ada.done("POST", "/control", {"lease_s": 60})
    for number in range(3):
        ada.done("POST", "/spectra", {"position_m": [number * 1e-7, 0], "key": f"curve-{number}"})
        assert ada.until_measured(f"curve-{number}")["state"] == "done"
    listed = ada.get("/spectra")
    before = [ada.get(f"/spectra/{one['id']}/values") for one in listed]
    assert len({bytes(one) for one in before}) == 3
    os.kill(run.pid("gateway"), signal.SIGKILL)
    run.wait_for("the gateway is at ", count=2)
    assert ada.get("/spectra") == listed
    assert [ada.get(f"/spectra/{one['id']}/values") for one in listed] == before
    assert ada.get("/spectra/newest/values") == before[-1]
    assert ada.ask("GET", "/spectra/1/values").code == "not-found"
    ada.done("POST", "/end")


def test_a_stalled_reader_is_dropped_and_continues_without_loss(started: Started, tmp_path: Path) -> None:
    (tmp_path / "impatient.py").write_text(
        "from afspm.plugins.web.gateway.gateway import Gateway\n\n\nclass Impatient(Gateway):\n    stalled_s = 1.0\n",
        encoding="utf-8",
    )
    file = tmp_path / "experiment.toml"
    plain = EXPERIMENT.format(speed=20.0, settings="")
    file.write_text(plain.replace('"Gateway"', '"impatient.Impatient"'), encoding="utf-8")
    run = started(file=file)
    ada, notes = run.client("ada"), [f"{number} " + 900 * "\N{MICROSCOPE}" for number in range(600)]
    for text in notes:  # more than the network keeps for a reader
        ada.done("POST", "/notes", {"text": text})
    with ExitStack() as stack:
        for _ in range(MOST_STREAMS - 1):
            stack.enter_context(_streaming(run, "/v1/events"))
        stalled = stack.enter_context(_streaming(run, "/v1/events?kinds=note&after=0"))
        assert ada.ask("GET", "/events").code == "too-many"
        _wait_until_dropped(psutil.Process(run.pid("gateway")), stalled.getsockname()[1])
        with stalled.makefile("rb") as stream:
            got = list(ada.read_events(stream))
        assert len(got) < len(notes)
        rest = ada.events("/events?kinds=note", last=got[-1].id if got else "0")  # its place is free
        got += [next(rest) for _ in range(len(notes) - len(got))]
        rest.close()
    assert [event.data["data"]["text"] for event in got] == notes
    ada.done("POST", "/end")


def test_strangers_can_not_take_control_or_lease_from_the_owner_of_a_token(started: Started) -> None:
    run = started(settings=f"people.ada = {hashed('secret')!r}")
    ada, guesser = run.client("ada", "secret"), run.client("ada", "guess")
    address = urlsplit(run.url)
    for _ in range(5):
        assert guesser.ask("POST", "/control", {}).code == "unauthorized"
    with ExitStack() as held:
        for _ in range(205):
            half = held.enter_context(socket.create_connection((address.hostname, address.port), DEADLINE_S))
            with suppress(ConnectionError):  # the oldest may be closed already
                half.sendall(b"GET /v1/state HTTP/1.1\r\nHost: 127.0.0.1\r\n")
        assert ada.done("POST", "/control", {"lease_s": 30}) == {"holder": "gateway:ada", "lease_s": 30}
        endless = held.enter_context(socket.create_connection((address.hostname, address.port), DEADLINE_S))
        endless.sendall(b"GET /v1/state HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Long: ")
        sent = 0
        with suppress(ConnectionError):
            while sent < 60 << 20:
                sent += endless.send(b"a" * 65536)
        assert sent < 16 << 20
        assert ada.done("PUT", "/control", {"lease_s": 30}) == {"holder": "gateway:ada", "lease_s": 30}
    ada.done("POST", "/end")


def _wait_until_dropped(process: psutil.Process, port: int) -> None:
    # until the process has no connection left with a client at this port
    end_s = time.monotonic() + DEADLINE_S
    while any(one.raddr and one.raddr.port == port for one in process.net_connections()):
        assert time.monotonic() < end_s, "it keeps its connection"
        time.sleep(0.1)


def _streaming(run: GatewayRun, path: str) -> socket.socket:
    # a small receive buffer: the stream stalls unless it is read
    host, _, port = Client(run.url).address.partition(":")
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.settimeout(DEADLINE_S)
    connection.connect((host, int(port)))
    connection.sendall(f"GET {path} HTTP/1.0\r\nHost: {host}:{port}\r\n\r\n".encode())
    assert connection.recv(12).endswith(b" 200")
    return connection


def test_twenty_clients_at_a_time_do_not_disturb_the_experiment(started: Started) -> None:
    scans, speed = 8, 20.0
    run = started(SERIES.format(every="1 min", scans=scans) + "end_when_done = true\n", speed=speed)
    over, refused, failed, waited_s = threading.Event(), list[str](), list[str](), [0.0]

    def watch(number: int) -> None:
        client = run.client(f"client {number}")
        while not over.is_set():
            try:
                client.get("/state")
                client.get("/parameters")
                client.get("/scans?limit=5")
                if client.get("/scans"):
                    client.get("/scans/newest/values")
                    client.get("/scans/newest/values?format=png")
                asked_s = time.monotonic()
                refused.append(client.ask("POST", "/actions/x-retract").code)
                waited_s.append(time.monotonic() - asked_s)
            except OSError:
                return
            except AssertionError as error:
                failed.append(str(error))

    def stream() -> None:
        for _ in run.client().events("/events?after=0"):
            pass

    stalled = HTTPConnection(Client(run.url).address)
    stalled.request("GET", "/v1/events?after=0")  # and never reads
    threads = [threading.Thread(target=watch, args=(i,), daemon=True) for i in range(16)]
    threads += [threading.Thread(target=stream, daemon=True) for _ in range(4)]
    for one in threads:
        one.start()
    gateway, most_bytes = psutil.Process(run.pid("gateway")), 0
    while run.process.poll() is None:
        try:
            most_bytes = max(most_bytes, gateway.memory_info().rss)
        except psutil.NoSuchProcess:
            break
        time.sleep(0.2)
    over.set()
    stalled.close()
    assert run.process.wait(DEADLINE_S) == 0
    assert not [line for line in run.lines if "WARNING" in line or "ERROR" in line], run.lines
    assert set(refused) <= {"not-in-control", "experiment-ended", "no-response"}
    assert refused
    assert not [one for one in failed if "experiment" not in one], failed[:3]
    assert most_bytes < 400 << 20
    with afspm.open_run(run.folder) as record:
        rows = [row for row in record.scans if not row.interrupted]
        assert len(rows) == scans
        began = [row.began_ns for row in rows if row.began_ns is not None]
        late_s = [abs((b - a) * 1e-9 - 60.0) for a, b in pairwise(began)]
        # of 60 s; a busy computer is late with everything: a scan at most as much as an answer to one of the clients
        assert max(late_s) < 15.0 + speed * max(waited_s), late_s
        assert {row.holder for row in rows} == {"series"}
