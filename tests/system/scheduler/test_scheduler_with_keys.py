"""A scheduler that authenticates its peers by their keys."""

from __future__ import annotations

from typing import Any

import zmq

from afspm.model import ControlRequest, ControlResponse, ScopeState, ScopeStatus
from afspm.wire import encode


def test_scheduler_with_keys_works_as_without(locked_rig: Any) -> None:
    locked_rig.start()
    experiment = locked_rig.component("Experiment")
    assert experiment.ask(ControlRequest.REQUEST_CTRL, 0).ok
    locked_rig.linked(experiment)
    assert experiment.ask(ControlRequest.ACTION, "start-scan").ok
    locked_rig.publish_packet(*encode(ScopeStatus(ScopeState.FREE)))
    locked_rig.until(lambda: experiment.packets("ScopeStateMsg"))


def test_known_key_does_not_allow_the_name_of_another_component(locked_rig: Any) -> None:
    locked_rig.start()
    experiment = locked_rig.component("Experiment")
    assert experiment.ask(ControlRequest.REQUEST_CTRL, 0).ok
    impostor = locked_rig.component("Experiment", owner="Visitor")
    refused = impostor.ask(ControlRequest.ACTION, "start-scan", key="Experiment/impostor/1")
    assert (refused.code, "this is the key of Visitor" in refused.reason) == (ControlResponse.FAILURE, True)
    assert not locked_rig.asked


def test_subscriber_without_a_key_receives_nothing(locked_rig: Any, plain: Any) -> None:
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
