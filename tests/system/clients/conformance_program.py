"""The conformance program of the plain Python client. An argument breaks it on purpose, in the way of that name."""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path

import numpy as np
from google.protobuf import json_format

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments" / "other_language"))
import wire_client
from wire_client import ACTION, CLEAR, END, FLAG, MESSAGES, MODE, PARAM, RELEASE, Refused, in_base64

BREAK = sys.argv[1] if len(sys.argv) > 1 else ""
SLOW = {"scan", "spectrum", "wait", "request", "request_control", "ready"}


def code_name(code):
    names = {v: k for k, v in wire_client.control_pb2.ControlResponse.items()}
    return names.get(code, code)


def response_facts(response):
    facts = {"ok": response.ok, "response": code_name(response.code), "object": in_base64(response.payload)}
    return facts | {"reason": response.reason, "detail": response.detail}


def packet_facts(packet):
    facts = {"envelope": packet.envelope, "message": packet.name, "timestamp_ns": packet.time_ns}
    if packet.name in ("Scan2d", "ScanLines"):
        center, size, angle = packet.region
        facts |= {"channel": packet.message.channel, "unit": packet.message.params.data.units}
        facts |= {"center_m": center, "size_m": size, "angle_deg": angle}
        facts |= {"shape": packet.shape if packet.name == "Scan2d" else packet.values.shape, "view": True}
    elif packet.name == "Spec1d":
        data, position = packet.message.data, packet.message.position
        scale = wire_client.METRES[position.units]
        facts |= {"kind": packet.message.type, "names": list(data.names), "units": list(data.units), "view": False}
        facts |= {"position_m": [position.point.x * scale, position.point.y * scale], "shape": packet.values.shape}
    else:
        return facts
    values = packet.values.ravel()
    if BREAK == "loses-the-order":
        values = np.sort(values)
    there = bool(values.size)
    facts["values"] = {
        "count": values.size,
        "first": float(values[0]) if there else None,
        "last": float(values[-1]) if there else None,
        "sum": float(values.sum()),
        "moment": float(np.arange(values.size, dtype=float) @ values),
    }
    return facts


class Steps:
    """Each step is a method."""

    def __init__(self, client):
        self.client = client

    def ready(self):
        self.client.ready()
        return {}

    def decode(self, message, bytes):
        import base64

        payload = base64.b64decode(bytes)
        if BREAK == "echoes":
            return {"bytes": bytes, "fields": {}}
        decoded = MESSAGES[message].FromString(payload)
        fields = json_format.MessageToDict(decoded, preserving_proto_field_name=True)
        return {"bytes": in_base64(decoded.SerializeToString()), "fields": fields}

    def encode(self, message, fields):
        if BREAK == "drops-zeros":
            fields = {name: value for name, value in fields.items() if value not in (0, 0.0, False)}
        return {"bytes": in_base64(json_format.ParseDict(fields, MESSAGES[message]()).SerializeToString())}

    def wait(self, prefix, timeout_s):
        inbox = self.client.inbox

        def found():
            return next((packet for packet in tuple(inbox) if packet.envelope.startswith(prefix)), None)

        if not self.client.wait(found, timeout_s):
            return {"ok": False, "error": f"no packet {prefix} in {timeout_s} s"}
        packet = found()
        inbox.remove(packet)
        return packet_facts(packet)

    def request(self, number, object=""):
        import base64

        return response_facts(self.client.request(number, base64.b64decode(object)))

    def request_control(self, problem, timeout_s):
        self.client.take_control(problem, time.monotonic() + timeout_s)
        return {}

    def release_control(self):
        self.client.demand(RELEASE)
        return {}

    def get_parameter(self, name):
        return self._parameter(parameter=name)

    def set_parameter(self, name, value, unit):
        given = {} if unit is None or BREAK == "drops-units" else {"units": unit}
        return self._parameter(parameter=name, value=value, **given)

    def _parameter(self, **fields):
        message = MESSAGES["ParameterMsg"]
        told = message.FromString(self.client.demand(PARAM, message(**fields).SerializeToString()))
        return {"value": told.value, "unit": told.units if told.HasField("units") else None}

    def action(self, name):
        self.client.demand(ACTION, MESSAGES["ActionMsg"](action=name).SerializeToString())
        return {}

    def problem(self, number, set):
        self.client.demand(FLAG if set else CLEAR, bytes([number]))
        return {}

    def mode(self, mode):
        self.client.demand(MODE, bytes([wire_client.control_pb2.ControlMode.Value(mode)]))
        return {}

    def end(self):
        self.client.demand(END)
        return {}

    def scan(self, center_m, size_m, angle_deg, shape, timeout_s):
        scans, interruptions = self.client.scan(center_m, size_m, angle_deg, shape, timeout_s)
        return {"scans": [packet_facts(scan) for scan in scans], "interruptions": interruptions}

    def spectrum(self, position_m, kind, timeout_s):
        spectra, interruptions = self.client.spectrum(position_m, kind, timeout_s)
        return {"spectra": [packet_facts(one) for one in spectra], "interruptions": interruptions}

    def state(self):
        control = self.client.control
        return {
            "in_control": self.client.in_control,
            "holder": control.client_in_control_id or None,
            "mode": wire_client.control_pb2.ControlMode.Name(control.control_mode),
            "problems": list(control.problems_set),
            "scope_state": self.client.scope_state,
        }


def perform(steps, step):
    number, do = step.pop("id"), step.pop("do")
    try:
        answer = {"id": number, "ok": True} | getattr(steps, do)(**step)
    except Refused as refused:
        answer = {"id": number} | response_facts(refused.response)
    except Exception as error:
        answer = {"id": number, "ok": False, "error": f"{type(error).__name__}: {error}"}
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


def main():
    launch = json.loads(sys.stdin.readline())
    client = client_of(launch)
    steps = Steps(client)
    for line in sys.stdin:
        step = json.loads(line)
        if step["do"] in SLOW:
            threading.Thread(target=perform, args=(steps, step), daemon=True).start()
        else:
            perform(steps, step)
    client.leave(0)


def client_of(launch):
    """Return the client, broken as was asked for."""
    if BREAK == "ignores-keys":  # and starts late, as on a busy computer: silence until then is no proof
        threading.Event().wait(2.5)
        launch["keys"] = None
    if BREAK == "same-life":
        wire_client.os.urandom = lambda count: b"\0" * count
    client = (BROKEN.get(BREAK) or wire_client.Client)(launch)
    if BREAK == "ignores-kill":
        client.leave = lambda code, why="": code == 80 or wire_client.Client.leave(client, code, why)
    return client


class NewIds(wire_client.Client):
    """Repeats a request with a new id."""

    def request(self, number, payload=b""):
        for _ in range(1 + self.launch["request_retries"]):
            asked = f"{self.name}/{self._life}/{next(self._numbers)}".encode()
            self._waiting.add(asked)
            self.wait(lambda: self.connected, 5.0)
            is_over = wire_client.partial(self._is_answered_or_lost, asked, self.connections)
            self._post([b"", bytes([number]), payload, asked])
            self.wait(is_over, self.launch["request_timeout_s"])
            if asked in self.answers:
                return self.answers.pop(asked)
        return wire_client.Response(3, b"", "", 2)


class AnyAnswer(wire_client.Client):
    """Takes whatever answer comes for its own."""

    def request(self, number, payload=b""):
        self._waiting = AllIds()
        asked = f"{self.name}/{self._life}/{next(self._numbers)}".encode()
        self.answers.clear()
        self._post([b"", bytes([number]), payload, asked])
        self.wait(lambda: self.answers, 5.0)
        return next(iter(self.answers.values()))


class AllIds(set):
    def __contains__(self, item):
        return True


class Beatless(wire_client.Client):
    """Beats without the token."""

    def __init__(self, launch):
        super().__init__(launch | {"beat_token": ""})


class BeatsBetween(wire_client.Client):
    """Beats only while it is not waiting for a step: it stops for long ones."""

    def _beat(self):
        address = self.launch["sockets"]["heartbeat"]
        socket = self._context.socket(wire_client.zmq.PUB)
        socket.connect(address)
        while not self.stopped:
            socket.send_multipart([b"\0", b"", b"", self.launch["beat_token"].encode()])
            self.wait(lambda: self.stopped, 8 * self.launch["beat_period_s"])
        socket.send_multipart([b"\1", b"", b"", self.launch["beat_token"].encode()])
        socket.close()


class Deaf(wire_client.Client):
    """Does not follow the state of control."""

    def take(self, packet):
        if packet.name != "ControlState" or self.control.client_in_control_id != self.name:
            super().take(packet)


class Brittle(wire_client.Client):
    """Gives up a scan that is interrupted."""

    def _attempt(self, *arguments):
        found = super()._attempt(*arguments)
        if not found:
            raise Refused(wire_client.Response(1, b"", "interrupted"))
        return found


class SinceTheBeginning(wire_client.Client):
    """Asks for all anew after a lost connection, and delivers it."""

    def __init__(self, launch):
        class Forgetful(wire_client.Subscription):
            def follow(self):
                self._newest, self._newest_of = -1, {}
                super().follow()

        wire_client.Subscription = Forgetful
        super().__init__(launch)


class Plain(wire_client.Client):
    """Subscribes without a marker."""

    def __init__(self, launch):
        class WithoutMarker(wire_client.Subscription):
            def follow(self):
                wire_client.recv_monitor_message(self.monitor)
                self.caught_up = True

        wire_client.Subscription = WithoutMarker
        super().__init__(launch)


class Fragile(wire_client.Client):
    """Ends over a packet that can't be read."""

    def __init__(self, launch):
        def end_over(line):
            self.leave(1)

        wire_client.say = end_over
        super().__init__(launch)


BROKEN = {
    "new-ids": NewIds,
    "any-answer": AnyAnswer,
    "no-token": Beatless,
    "rare-beats": BeatsBetween,
    "deaf-to-control": Deaf,
    "gives-up-scans": Brittle,
    "all-anew": SinceTheBeginning,
    "no-marker": Plain,
    "ends-over-bad-packets": Fragile,
}

if __name__ == "__main__":
    main()
