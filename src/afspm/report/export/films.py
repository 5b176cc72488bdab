"""Films (.gif, .mp4): a film of the first channel for each place scanned at least twice with the same channels."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

from afspm.basics.errors import InvalidValue
from afspm.night.run import Run
from afspm.night.tables import ScanRow, SpectrumRow
from afspm.report.export import file_word
from afspm.report.film import film_of, places, recorded_drift

_log = logging.getLogger("afspm.record")


class FilmExporter:
    """An exporter of films with one suffix. See `afspm.report.export`."""

    def __init__(self, suffix: str) -> None:
        self._suffix = suffix

    def archive(self, run: Run, scans: Sequence[ScanRow], _: Sequence[SpectrumRow], folder: Path) -> Iterator[Path]:
        """Write the films and yield each path.

        Raises:
            InvalidValue: no place was scanned twice.
            FileError: a file can't be written.
        """
        drift = recorded_drift(run)
        groups = places(scans, drift)
        if not groups:
            raise InvalidValue("a film needs two scans of one place, and there are none", where=str(run.folder))
        for number, rows in enumerate(groups, 1):
            try:
                film = film_of(run, rows, drift=drift)
            except InvalidValue as error:  # damaged files of one place cost no other place its film
                _log.warning("film %d is not made: %s", number, error)
                continue
            yield film.save(folder / f"film-{number:02}-{file_word(film.channel)}{self._suffix}")


GIF = FilmExporter(".gif")
MP4 = FilmExporter(".mp4")
