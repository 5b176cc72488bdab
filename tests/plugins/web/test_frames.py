from __future__ import annotations

import numpy as np
import pytest

from afspm.components import Levelling
from afspm.model import ChannelRoles, Region, Scan, ScanLines
from afspm.plugins.web.dashboard.pictures import Look, PictureCache
from afspm.plugins.web.frames import MEMORY_BYTES, MOST_CHANNELS, FrameStore

REGION = Region((0.0, 0.0), (1e-6, 1e-6))
SHAPE = (8, 6)
S = 1_000_000_000


def scan(value: float, time_ns: int, channel: str = "Height", shape: tuple[int, int] = SHAPE) -> Scan:
    return Scan(REGION, channel, "m", np.full(shape, value), time_ns)


def lines(row: int, value: float, began_ns: int = 10 * S, count: int = 1) -> ScanLines:
    return ScanLines(REGION, SHAPE, "Height", "m", row, np.full((count, SHAPE[1]), value), began_ns)


def test_a_frame_grows_line_by_line_and_is_then_complete() -> None:
    store = FrameStore()
    for row in range(3):
        store.take_lines(lines(row, float(row)))
    growing = store.newest("Height")
    assert growing is not None
    assert not growing.complete
    assert growing.rows == 3
    assert growing.newest_row == 2
    assert np.isnan(growing.values[3:]).all()
    store.take_scan(scan(5.0, 20 * S), 20 * S)
    whole = store.newest("Height")
    assert whole is not None
    assert whole.complete
    assert whole.number > growing.number
    assert (whole.values == 5.0).all()


def test_a_returned_copy_of_a_growing_frame_does_not_change() -> None:
    store = FrameStore()
    store.take_lines(lines(0, 1.0))
    before = store.newest()
    store.take_lines(lines(1, 2.0))
    assert before is not None
    assert np.isnan(before.values[1]).all()


def test_a_downward_scan_has_its_newest_row() -> None:
    store = FrameStore()
    store.take_lines(lines(7, 1.0))
    store.take_lines(lines(6, 1.0))
    store.take_lines(lines(5, 1.0))
    frame = store.newest()
    assert frame is not None
    assert frame.newest_row == 5
    assert frame.rows == 3


def test_lines_of_a_new_scan_begin_a_new_picture() -> None:
    store = FrameStore()
    store.take_lines(lines(0, 1.0, 10 * S, count=8))
    store.take_lines(lines(0, 2.0, 30 * S))
    frame = store.newest()
    assert frame is not None
    assert frame.rows == 1
    assert frame.values[0, 0] == 2.0


def test_late_lines_of_a_finished_scan_change_nothing() -> None:
    store = FrameStore()
    store.take_lines(lines(0, 1.0, 10 * S))
    store.take_scan(scan(5.0, 20 * S), 20 * S)
    store.take_lines(lines(1, 9.0, 10 * S))
    frame = store.newest()
    assert frame is not None
    assert frame.complete


def test_an_older_scan_that_is_replayed_does_not_replace_a_newer_one() -> None:
    store = FrameStore()
    store.take_scan(scan(2.0, 20 * S), 20 * S)
    store.take_scan(scan(1.0, 10 * S), 10 * S)
    store.take_scan(scan(2.5, 20 * S), 20 * S)
    frame = store.newest()
    assert frame is not None
    assert frame.values[0, 0] == 2.0


def test_each_channel_has_its_own_newest() -> None:
    store = FrameStore()
    store.take_scan(scan(1.0, 10 * S, "Height"), 10 * S)
    store.take_scan(scan(2.0, 10 * S, "Phase"), 10 * S)
    assert store.channels == ("Height", "Phase")
    phase, first = store.newest("Phase"), store.newest()
    assert phase is not None
    assert first is not None
    assert (phase.values[0, 0], first.channel) == (2.0, "Height")
    assert store.newest("Amplitude") is None


def test_topography_is_shown_before_a_channel_that_came_first() -> None:
    store = FrameStore()
    store.take_scan(scan(1.0, 20 * S, "Phase"), 20 * S)
    store.roles = ChannelRoles({"height": ("Z Forward",)}).with_topography(feedback_on=True)
    store.take_scan(scan(2.0, 20 * S, "Z Forward"), 20 * S)
    newest = store.newest()
    assert newest is not None
    assert (newest.channel, store.channels) == ("Z Forward", ("Z Forward", "Phase"))


def test_finished_scans_are_kept_within_the_memory_bound() -> None:
    size = 8 * 8 * 6
    store = FrameStore(memory_bytes=10 * size)
    for i in range(1, 1001):
        store.take_scan(scan(float(i), i * S), i * S)
        assert store.kept_bytes <= 10 * size
    assert store.kept(1000 * S, "Height") is not None
    assert store.kept(991 * S, "Height") is not None
    assert store.kept(990 * S, "Height") is None


def test_a_scan_without_values_is_no_picture() -> None:
    store = FrameStore()
    store.take_scan(scan(1.0, 10 * S, shape=(0, 0)), 10 * S)
    assert store.newest() is None
    assert store.newest_number() == (0, False)


def test_a_picture_is_drawn_once_for_all_viewers_with_the_same_look() -> None:
    store, drawer = FrameStore(), PictureCache()
    store.take_scan(scan(1.0, 10 * S), 10 * S)
    frame = store.newest()
    assert frame is not None
    plane = drawer.draw(frame, Look())
    assert drawer.draw(frame, Look()) is plane
    assert drawer.draw(frame, Look(Levelling.NONE)) is not plane


def test_compared_pictures_are_drawn_with_one_range() -> None:
    store, drawer = FrameStore(), PictureCache()
    frames = []
    for number, height in enumerate((1.0, 5.0), 1):
        store.take_scan(Scan(REGION, "Height", "m", np.linspace(0.0, height, 64).reshape(8, 8)), number * S)
        frames.append(store.newest())
    first, second = frames
    assert first is not None
    assert second is not None
    look = Look(Levelling.NONE)
    assert drawer.draw(first, look, second).span == drawer.draw(second, look, first).span
    assert drawer.draw(first, look).span != drawer.draw(second, look).span


def test_the_head_has_the_data_for_axes_and_fits_a_header() -> None:
    store = FrameStore()
    named = Scan(REGION, "Höhe \n\r Retrace", "m", np.ones((2, 3)), 1763600000123456789)
    store.take_scan(named, 0)
    frame = store.newest()
    assert frame is not None
    head = PictureCache().draw(frame, Look()).head([("Scan", "no. 1")])
    assert head.isascii()
    assert head.isprintable()
    assert '"1763600000123456789"' in head  # as text: JavaScript's numbers are not that exact
    assert '"shape": [2, 3]' in head


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_can_be_drawn(value: float) -> None:
    store = FrameStore()
    store.take_scan(scan(value, 10 * S), 10 * S)
    frame = store.newest()
    assert frame is not None
    assert PictureCache().draw(frame, Look()).png.startswith(b"\x89PNG")


def test_lines_that_announce_millions_of_rows_take_no_memory() -> None:
    store = FrameStore()
    store.take_lines(lines(0, 1.0))
    announced = ScanLines(REGION, (3_000_000, 1000), "Phase", "V", 0, np.ones((1, 1000)), 20 * S)
    store.take_lines(announced)
    assert store.channels == ("Height",)
    wide = [ScanLines(REGION, (1000, 1000), f"c{i}", "V", 0, np.ones((1, 1000)), 20 * S) for i in range(40)]
    for one in wide:
        store.take_lines(one)
    frames = [store.newest(channel) for channel in store.channels]
    assert 20 < len(frames) < 30
    assert sum(frame.values.nbytes for frame in frames if frame is not None) <= MEMORY_BYTES


def test_channels_without_end_push_out_the_oldest() -> None:
    store = FrameStore()
    for i in range(3 * MOST_CHANNELS):
        store.take_scan(scan(1.0, i + 1, f"channel {i}"), i + 1)
    assert len(store.channels) == MOST_CHANNELS
    assert store.newest(f"channel {3 * MOST_CHANNELS - 1}") is not None


def test_row_with_a_changed_tip_is_marked_in_the_scan_that_is_running() -> None:
    store = FrameStore()
    store.take_lines(lines(0, 1.0, began_ns=7))
    before = store.newest_number()
    store.take_change(7, 1)
    frame = store.newest()
    assert frame is not None
    assert frame.changed_row == 1
    assert store.newest_number() > before, "a page that waits for a newer picture gets this one"
    store.take_lines(lines(1, 1.0, began_ns=7))
    assert (store.newest() or frame).changed_row == 1
    store.take_lines(lines(0, 1.0, began_ns=9))
    assert (store.newest() or frame).changed_row is None
