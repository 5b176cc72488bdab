"""The newest spectra, with their values."""

from __future__ import annotations

from collections import deque

from afspm.model import Spectrum

KEPT = 200
MOST_BYTES = 64 << 20


class SpectrumStore:
    """The newest spectra, in the order in which they came. Not for several threads at once."""

    def __init__(self) -> None:
        self._kept: deque[tuple[int, Spectrum]] = deque()
        self._bytes = 0
        self._newest_ns = -1

    def take(self, spectrum: Spectrum, time_ns: int) -> None:
        """One was published; of what is not newer (a replay) nothing is taken."""
        if time_ns <= self._newest_ns:
            return
        self._newest_ns = time_ns
        self._kept.append((spectrum.time_ns or time_ns, spectrum))
        self._bytes += spectrum.values.nbytes
        while len(self._kept) > KEPT or (self._bytes > MOST_BYTES and len(self._kept) > 1):
            self._bytes -= self._kept.popleft()[1].values.nbytes

    def __len__(self) -> int:
        return len(self._kept)

    def newest(self, count: int = 1) -> list[tuple[int, Spectrum]]:
        """(time_ns, spectrum), newest last."""
        return list(self._kept)[-count:]

    def at(self, time_ns: int) -> Spectrum | None:
        """The one of that time; None if it is not kept any more."""
        return next((spectrum for at_ns, spectrum in self._kept if at_ns == time_ns), None)
