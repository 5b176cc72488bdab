"""Errors as a notebook shows them."""

from __future__ import annotations

import linecache

import numpy as np
import pytest

from afspm import Region
from afspm.basics.errors import AfspmError, Interrupted, InvalidValue
from afspm.client.interrupts import Interrupts
from afspm.model import Scan, ScanSet

CELL = "def frame(height):\n    return Region((0, 0), (1e-6, height))\n\nframe(0)\n"


class InterruptedPort:
    """All that an interrupt needs of a port."""

    def wake_up(self) -> None: ...


def shown(name: str) -> list[str]:
    """Return the lines that IPython shows for the error of a cell, whose lines it keeps to quote them."""
    linecache.cache[name] = (len(CELL), None, CELL.splitlines(keepends=True), name)
    with pytest.raises(AfspmError) as caught:
        exec(compile(CELL, name, "exec"), {"Region": Region})
    return caught.value._render_traceback_()


@pytest.mark.parametrize("name", ["<ipython-input-3-abc>", "/tmp/ipykernel_12/34.py"])
def test_a_notebook_shows_the_error_and_the_lines_of_the_cell_alone(name: str) -> None:
    first, *rest = shown(name)
    assert "InvalidValue" in first
    assert "a region of 1 x 0 µm is empty (both sizes are above zero)" in first
    assert rest[-2:] == [
        "  line 4 of the cell: frame(0)",
        "  line 2 of the cell: return Region((0, 0), (1e-6, height))",
    ]
    assert not any("geometry.py" in line for line in rest)


def test_missing_item_is_a_key_error_with_a_readable_message() -> None:
    scans = ScanSet([Scan(Region((0, 0), (1, 1)), "Height", "m", np.zeros((2, 2)))])
    assert scans.get("Z") is None
    assert "Z" not in scans
    with pytest.raises(KeyError) as caught:
        scans["Z"]
    assert str(caught.value) == "no channel 'Z'; there are Height"


def test_a_notebook_shows_an_interrupt_without_the_lines_of_afspm() -> None:
    interrupts = Interrupts(InterruptedPort())  # type: ignore[arg-type]
    interrupts.interrupt()
    with pytest.raises(KeyboardInterrupt) as caught:
        interrupts.heed()
    assert isinstance(caught.value, Interrupted)
    first, *rest = caught.value._render_traceback_()
    assert "Interrupted" in first
    assert rest == [f"  line {caught.traceback[0].lineno + 1} of {__file__}: interrupts.heed()"]


def test_a_file_of_the_user_is_named() -> None:
    with pytest.raises(InvalidValue) as caught:
        Region((0, 0), (0, 0))
    assert f"of {__file__}: Region((0, 0), (0, 0))" in caught.value._render_traceback_()[-1]
