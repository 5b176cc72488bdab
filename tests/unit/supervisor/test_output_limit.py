"""Endless output of a process is dropped, except its beginning, samples of it, and its end."""

from __future__ import annotations

from afspm.supervisor.child_output import AT_ONCE, BYTES_PER_S, LAST_BYTES, PAUSE_S, STAMP_BYTES, OutputLimit

LINE = b"still waiting for the stage\n"
COST = len(LINE) + STAMP_BYTES
NIGHT_S = 36_000.0


def flooded(now_s: float = 0.0) -> OutputLimit:
    thinning = OutputLimit(now_s)
    while thinning.passes(LINE, now_s):
        pass
    return thinning


def test_moderate_output_all_night_is_kept_in_full() -> None:
    thinning, period_s = OutputLimit(0.0), COST / BYTES_PER_S
    assert all(thinning.passes(LINE, i * period_s) for i in range(100_000))


def test_burst_of_output_is_kept() -> None:
    thinning = OutputLimit(0.0)
    assert all(thinning.passes(LINE, 0.0) for _ in range(AT_ONCE // COST))
    assert not thinning.passes(LINE, 0.0)


def test_a_night_of_printing_is_no_more_than_the_disk_can_take() -> None:
    thinning, kept, now_s, hours_s = OutputLimit(0.0), 0, 0.0, NIGHT_S / 10
    while now_s < hours_s:
        if thinning.passes(LINE, now_s):
            kept += COST
        else:
            now_s += PAUSE_S
            kept += COST * len(thinning.go_on()[1])
    assert AT_ONCE < kept < AT_ONCE + 1.5 * BYTES_PER_S * hours_s


def test_endless_line_comes_in_pieces_that_are_dropped_too() -> None:
    thinning = flooded()
    for _ in range(100):
        assert not thinning.passes(b"." * 65_536, 1.0)
    left_out, last = thinning.go_on()
    assert last == [b"." * 65_536]
    assert left_out == 100


def test_last_dropped_lines_are_kept_and_the_rest_counted() -> None:
    thinning = flooded()
    for i in range(1000):
        assert not thinning.passes(b"line %d\n" % i, 1.0)
    for line in (b"ERROR no stage\n", b"Traceback:\n"):
        thinning.passes(line, 1.0)
    left_out, last = thinning.go_on()
    assert last[-2:] == [b"ERROR no stage\n", b"Traceback:\n"]
    assert sum(len(line) + STAMP_BYTES for line in last) <= LAST_BYTES
    assert left_out + len(last) == 1 + 1000 + 2


def test_output_passes_again_after_the_pause() -> None:
    thinning = flooded()
    assert not thinning.passes(LINE, PAUSE_S - 0.1)
    thinning.go_on()
    assert thinning.passes(LINE, PAUSE_S)
    assert thinning.go_on() == (0, [])
