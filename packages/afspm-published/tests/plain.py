"""A translator of version 1, made without afspm: REP and PUB sockets, generated messages, no reasons and no ids.

It scans, and has no more than that.
"""

from __future__ import annotations

import json
import math
import sys
import threading
import time
from typing import Any

import zmq
from google.protobuf.timestamp_pb2 import Timestamp

from afspm.wire.generated import control_pb2, scan_pb2

SUCCESS, NOT_SUPPORTED, NOT_FREE, NO_PARAM, PARAM_ERROR, NO_ACTION = 0, 2, 7, 8, 9, 11
SCANNING, FREE, INTERRUPTED, MOVING = 2, 3, 4, 1
UNITS = {"m": 1.0, "nm": 1e-9, "": 1.0}
LIMIT_M = 1e-4
PLACES = {
    "scan-top-left-x": ("top_left", "x"),
    "scan-top-left-y": ("top_left", "y"),
    "scan-size-x": ("size", "x"),
    "scan-size-y": ("size", "y"),
}


class Refused(Exception):
    pass


class Plain:
    def __init__(self, launch: dict[str, Any]) -> None:
        self._clock = launch["clock"]
        context: zmq.Context[Any] = zmq.Context()
        self._rep, self._pub = context.socket(zmq.REP), context.socket(zmq.XPUB)
        self._rep.bind(launch["sockets"]["serve"])
        self._pub.bind(launch["sockets"]["publish"])
        self._newest_ns = 0
        self._ends_s: float | None = None
        self._frame = scan_pb2.ScanParameters2d()
        self._frame.spatial.length_units, self._frame.spatial.angular_units = "m", "deg"
        roi = self._frame.spatial.roi
        roi.top_left.x = roi.top_left.y = -5e-7
        roi.size.x = roi.size.y = 1e-6
        roi.angle = 0.0
        self._frame.data.shape.x = self._frame.data.shape.y = 32

    def now_s(self) -> float:
        clock = self._clock
        return float(clock["start_s"] + (time.time() - clock["origin_s"]) * clock["speed"])

    def run(self) -> None:
        poller = zmq.Poller()
        poller.register(self._rep, zmq.POLLIN)
        poller.register(self._pub, zmq.POLLIN)
        while True:
            ready = dict(poller.poll(20))
            if self._pub in ready and self._pub.recv()[:1] == b"\1":
                self._publish(self._frame)
                self._say(FREE if self._ends_s is None else SCANNING)
            if self._rep in ready:
                self._answer(self._rep.recv_multipart())
            if self._ends_s is not None and self.now_s() >= self._ends_s:
                self._finish()

    def _answer(self, frames: list[bytes]) -> None:
        kind, payload = frames[0][0], frames[1] if len(frames) > 1 else b""
        try:
            reply, after = self._do(kind, payload)
        except Refused as refused:
            reply, after = [bytes(refused.args)], []
        self._rep.send_multipart(reply)
        for one in after:
            self._say(one) if isinstance(one, int) else self._publish(one)

    def _do(self, kind: int, payload: bytes) -> tuple[list[bytes], list[Any]]:
        if kind == 1:
            return self._act(control_pb2.ActionMsg.FromString(payload).action)
        if kind == 2:
            return self._parameter(control_pb2.ParameterMsg.FromString(payload))
        if kind == 3:
            return self._set_frame(scan_pb2.ScanParameters2d.FromString(payload))
        raise Refused(NOT_SUPPORTED)

    def _act(self, action: str) -> tuple[list[bytes], list[Any]]:
        if action == "start-scan":
            if self._ends_s is not None:
                raise Refused(NOT_FREE)
            self._ends_s = self.now_s() + 40.0
            return [bytes([SUCCESS])], [SCANNING]
        if action == "stop-scan":
            told = [] if self._ends_s is None else [INTERRUPTED, FREE]
            self._ends_s = None
            return [bytes([SUCCESS])], told
        raise Refused(NO_ACTION)

    def _parameter(self, asked: control_pb2.ParameterMsg) -> tuple[list[bytes], list[Any]]:
        if asked.parameter not in PLACES:
            raise Refused(NO_PARAM)
        part, axis = PLACES[asked.parameter]
        after: list[Any] = []
        if asked.HasField("value"):
            wanted = scan_pb2.ScanParameters2d()
            try:
                setattr(getattr(wanted.spatial.roi, part), axis, float(asked.value))
            except ValueError:
                raise Refused(PARAM_ERROR) from None
            wanted.spatial.length_units = asked.units
            after = self._set_frame(wanted)[1]
        told = control_pb2.ParameterMsg(parameter=asked.parameter, units="m")
        told.value = repr(getattr(getattr(self._frame.spatial.roi, part), axis))
        return [bytes([SUCCESS]), told.SerializeToString()], after

    def _set_frame(self, asked: scan_pb2.ScanParameters2d) -> tuple[list[bytes], list[Any]]:
        if self._ends_s is not None:
            raise Refused(NOT_FREE)
        unit = UNITS.get(asked.spatial.length_units)
        new = scan_pb2.ScanParameters2d()
        new.CopyFrom(self._frame)
        for part in ("top_left", "size"):
            for axis in "xy":
                given = getattr(asked.spatial.roi, part)
                if given.HasField(axis):
                    value = getattr(given, axis) * (unit or math.nan)
                    if not abs(value) <= LIMIT_M or (part == "size" and value <= 0):
                        raise Refused(PARAM_ERROR)
                    setattr(getattr(new.spatial.roi, part), axis, value)
        for axis in "xy":
            if asked.data.shape.HasField(axis):
                setattr(new.data.shape, axis, getattr(asked.data.shape, axis))
        self._frame.CopyFrom(new)
        return [bytes([SUCCESS])], [MOVING, self._frame, FREE]

    def _finish(self) -> None:
        shape = self._frame.data.shape
        scan = scan_pb2.Scan2d(params=self._frame, channel="Z", values=[0.0] * (shape.x * shape.y))
        scan.timestamp.FromNanoseconds(int((self._ends_s or 0.0) * 1e9))
        self._ends_s = None
        self._publish(scan)
        self._say(FREE)

    def _say(self, state: int) -> None:
        self._publish(control_pb2.ScopeStateMsg(scope_state=state))  # type: ignore[arg-type]

    def _publish(self, message: Any) -> None:
        self._newest_ns = max(self._newest_ns + 1, int(self.now_s() * 1e9))
        stamp = Timestamp(seconds=self._newest_ns // 10**9, nanos=self._newest_ns % 10**9)
        self._pub.send_multipart(
            [message.DESCRIPTOR.name.encode(), message.SerializeToString(), stamp.SerializeToString()]
        )


if __name__ == "__main__":
    plain = Plain(json.loads(sys.stdin.readline()))
    threading.Thread(target=plain.run, daemon=True).start()
    sys.stdin.read()  # until who has started it lets it go
