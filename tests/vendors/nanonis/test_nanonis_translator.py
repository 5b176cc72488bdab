"""The Nanonis translator against the emulated controller: everything that a peer may ask for, as it sees it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from nanonis_bench import Bench, Peer, states

from afspm.model import (
    ControlRequest,
    ControlResponse,
    Feedback,
    ProbePosition,
    Region,
    Scan,
    ScanParameters,
    ScopeState,
    Spectrum,
    names,
)

FREE = ScopeState.FREE
TURNED = Region((40e-9, -25e-9), (300e-9, 100e-9), math.radians(30))


def ready(peer: Peer, region: Region = TURNED, shape: tuple[int, int] = (12, 32)) -> None:
    """A small frame is in force, and all that comes of it was heard."""
    peer.until(FREE)
    response = peer.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(region, shape, ""))
    assert response.ok, response.reason
    peer.until(lambda one: isinstance(one, ScanParameters) and one.region == region and one.shape == shape)
    peer.until(FREE)


def scanned(peer: Peer) -> list[Scan]:
    assert peer.act(names.START_SCAN).ok
    heard = peer.until(FREE)
    assert states(heard) == ["SCANNING", "FREE"]
    return [one for one in heard if isinstance(one, Scan)]


def test_a_scan_comes_with_the_frame_that_was_set_exactly(bench: Callable[..., Bench]) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    scans = scanned(peer)
    assert {scan.channel for scan in scans} >= {"Z Forward", "Z Backward", "Current Forward"}
    for scan in scans:
        assert scan.region == TURNED
        assert scan.shape == (12, 32)
        assert scan.filename.endswith("unnamed001.sxm")
