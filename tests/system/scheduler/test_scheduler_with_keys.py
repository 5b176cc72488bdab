"""A scheduler that knows whose keys it hears."""

from __future__ import annotations

from typing import Any

import zmq

from afspm.model import ControlRequest, ControlResponse, ScopeState, ScopeStatus
from afspm.wire import encode


def test_with_keys_everything_works_as_without(locked_rig: Any) -> None:
    locked_rig.start()
    experiment = locked_rig.component("Experiment")
    assert experiment.ask(ControlRequest.REQUEST_CTRL, 0).ok
    locked_rig.linked(experiment)
    assert experiment.ask(ControlRequest.ACTION, "start-scan").ok
    locked_rig.publish_packet(*encode(ScopeStatus(ScopeState.FREE)))
    locked_rig.until(lambda: experiment.packets("ScopeStateMsg"))


def test_nobody_speaks_for_another_even_with_a_key_that_is_known(locked_rig: Any) -> None:
    locked_rig.start()
    experiment = locked_rig.component("Experiment")
    assert experiment.ask(ControlRequest.REQUEST_CTRL, 0).ok
    impostor = locked_rig.component("Experiment", owner="Visitor")
    refused = impostor.ask(ControlRequest.ACTION, "start-scan", key="Experiment/impostor/1")
    assert (refused.code, "the key is that of Visitor" in refused.reason) == (ControlResponse.FAILURE, True)
    assert not locked_rig.asked


def test_without_a_key_nothing_is_heard(locked_rig: Any, plain: Any) -> None:
    locked_rig.start()
    experiment = locked_rig.component("Experiment")
    stranger, listener = plain(zmq.DEALER), plain(zmq.SUB)
    stranger.setsockopt(zmq.ROUTING_ID, b"Stranger")
    stranger.connect(locked_rig.serve)
    stranger.send_multipart([b"", bytes([ControlRequest.END_EXPERIMENT])])
    listener.setsockopt(zmq.SUBSCRIBE, b"")
    listener.connect(locked_rig.publish)
    for _ in range(20):
        assert experiment.ask(ControlRequest.REQUEST_CTRL, 0).ok
        assert experiment.ask(ControlRequest.RELEASE_CTRL).ok
    assert not stranger.poll(0)
    assert not listener.poll(0)
