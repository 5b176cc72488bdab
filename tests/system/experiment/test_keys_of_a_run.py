"""Each process has keys of its own even if the file has none: roles hold on one computer."""

from __future__ import annotations

from typing import Any

import pytest
import zmq
from tests.system.experiment.experiment_lab import Run, lasting, require_each_once

import afspm
from afspm import wire
from afspm.basics.errors import AfspmError
from afspm.client.connect import guest_of
from afspm.model import ControlRequest, Request

THIEF = """
from afspm import wire
from afspm.model import ControlRequest, Request
from afspm.client.component import Component
from afspm.transport.network import Network
import zmq


class Thief(Component):
    def run_process(self, context):
        self.launch = context.launch
        return super().run_process(context)

    def on_start(self):
        for claimed in ("witness", "terminal"):
            network = Network.from_launch(self.name, self.launch.keys)
            socket = network.socket(zmq.DEALER)
            socket.setsockopt(zmq.ROUTING_ID, claimed.encode())
            network.connect(socket, self.launch.sockets.control)
            request = Request(ControlRequest.END_EXPERIMENT, id=claimed + "/thief/1")
            socket.send_multipart([b"", *wire.encode_request(request)])
            frames = [b""]
            while frames == [b""] and socket.poll(480_000):  # an empty message only looks whether a client is there
                frames = socket.recv_multipart()
            said = wire.decode_response(frames[1:]).reason if frames != [b""] else "nothing"
            self.log.info("was told: %s", said)
            network.close()
"""
MORE = """
[thief]
component = true
class = "thief.Thief"

[control.roles]
end_experiment = ["witness", "series"]
"""


def test_component_without_a_role_can_not_take_the_name_of_one_with_the_role(run: Run, tmp_path: Any) -> None:
    (tmp_path / "thief.py").write_text(THIEF, encoding="utf-8")
    # the series too, which ends the run only once the others were refused
    one = run(more=MORE, over=lasting(tmp_path), scans=1000)
    for claimed in ("witness", "terminal"):
        one.wait_for(" thief ", f"was told: this is the key of thief, not of {claimed}")
    with afspm.connect(one.folder, "witness") as scope, pytest.raises(AfspmError, match="this is the key of guest"):
        scope.end_experiment()
    with afspm.connect(one.folder, "ada") as scope, pytest.raises(AfspmError, match="does not have the role"):
        scope.end_experiment()
    assert "secret" not in (one.folder / "run.json").read_text(encoding="utf-8")
    require_each_once(one, one.end_lasting())
    assert not (one.folder / "state" / "guest.keys").exists()


@pytest.mark.parametrize("open_to_all", [False, True])
def test_program_without_keys_joins_if_the_file_allows_it(run: Run, open_to_all: bool) -> None:
    one = run(scans=1000, more="[security]\ninsecure = true\n" if open_to_all else "")
    one.wait_for("scan 1 of 1000")
    control = guest_of(one.folder, "bare").sockets.control
    assert control is not None
    with zmq.Context() as context, context.socket(zmq.REQ) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.ROUTING_ID, b"bare")
        socket.connect(control)
        socket.send_multipart(wire.encode_request(Request(ControlRequest.END_EXPERIMENT)))
        if open_to_all:
            assert wire.decode_response(socket.recv_multipart()).ok
            assert one.end() == 0, one.output
        else:
            # the program sees first that it has no key, and tries only once: it may hang up before the scheduler looks
            one.wait_for(" scheduler ", r"\[security\] insecure = true|a program without keys gave up")
            assert socket.poll(0) == 0
