"""A recorded run as documents of Bluesky, without Bluesky."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import afspm
from afspm import wire
from afspm.model import Packet, Region, Scan, Spectrum
from afspm.plugins.bluesky.documents import documents
from afspm.record.store import RecordSettings, RecordStore

REGION = Region((1e-6, 2e-6), (3e-7, 4e-7), 0.1)
CHANNELS = ("Height", "Angle", "Center X", "Key")
VARIABLES = ("Bias", "X", "Y")


def recorded(folder: Path) -> list[tuple[str, dict[str, Any]]]:
    """Return the documents of a run with channels and variables that are named as numbers of an event."""
    things: list[object] = [Scan(REGION, name, "m", np.full((4, 5), n), 1000) for n, name in enumerate(CHANNELS)]
    values = np.arange(18.0).reshape(6, 3)
    things.append(Spectrum((1e-9, 2e-9), "IV", VARIABLES, ("V", "A", "A"), values, 2000))
    store = RecordStore(folder, RecordSettings({"experiment": "night", "simulated": True, "frame": "tip"}))
    encoded = [wire.encode(thing) for thing in things]
    store.take((Packet(name, payload, 10_000 + n), "") for n, (name, payload) in enumerate(encoded))
    store.flush()
    store.close()
    (folder / "run.json").write_text("{}", encoding="utf-8")
    with afspm.open_run(folder) as run:
        return [(name, dict(document)) for name, document in documents(run, run.scans, run.spectra)]


def test_no_channel_is_lost_to_a_number_of_the_event(tmp_path: Path) -> None:
    found = recorded(tmp_path)
    descriptors = {one["name"]: one["data_keys"] for name, one in found if name == "descriptor"}
    arrays = {
        stream: {key for key, one in keys.items() if one["dtype"] == "array"} for stream, keys in descriptors.items()
    }
    assert arrays["scans"] == {"height", "channel_angle", "channel_center_x", "channel_key"}
    assert arrays["spectra"] == {"bias", "channel_x", "channel_y"}
    resources = [one for name, one in found if name == "stream_resource"]
    assert {one["data_key"] for one in resources} == arrays["scans"] | arrays["spectra"]
    for one in resources:
        path = one["uri"].removeprefix("file://localhost")
        path = path if Path(path).exists() else path.removeprefix("/")
        stream = "scans" if one["data_key"] in arrays["scans"] else "spectra"
        with h5py.File(path) as file:
            data, key = file[one["parameters"]["dataset"]], descriptors[stream][one["data_key"]]
            assert (list(data.shape), data.dtype.str) == (key["shape"], key["dtype_numpy"])
    assert descriptors["scans"]["interrupted"]["dtype"] == "boolean"
    events = [one["data"] for name, one in found if name == "event"]
    assert events[0]["interrupted"] is False
    assert [events[0][key] for key in ("size_x", "size_y", "angle")] == pytest.approx([3e-7, 4e-7, 0.1])
    assert (events[1]["x"], events[1]["y"]) == pytest.approx((1e-9, 2e-9))
