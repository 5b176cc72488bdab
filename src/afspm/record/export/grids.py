"""The spectra of a run that lie on a grid, as one array for each kind."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress

from afspm.errors import FileError, InvalidValue
from afspm.model import Spectrum
from afspm.model.spectrum_stack import SpectrumStack, stacked
from afspm.record.run import Run
from afspm.record.tables import SpectrumRow


def grids(run: Run, rows: Sequence[SpectrumRow]) -> Iterator[tuple[str, SpectrumStack]]:
    """Yield each grid of at least two by two spectra that were measured alike, with the name of its file.

    A spectrum whose file is damaged is left out, as one that was not measured.
    """
    spectra: dict[tuple[str, tuple[str, ...]], list[Spectrum]] = {}
    for row in rows:
        with suppress(FileError):
            spectrum = run.spectrum(row)
            spectra.setdefault((spectrum.kind, spectrum.names), []).append(spectrum)
    for number, ((kind, _), alike) in enumerate(spectra.items(), 1):
        with suppress(InvalidValue):  # not on a grid
            stack = stacked(alike, interpolate=True)
            if min(len(stack.points.x_m), len(stack.points.y_m)) > 1:
                name = re.sub(r"[^\w-]+", "-", kind).strip("-") or "spectra"
                yield f"grid-{number:02}-{name}", stack
