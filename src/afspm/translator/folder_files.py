"""The results of a controller that saves each measurement to a new file in a folder, or to several."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import AfspmError, FileError
from afspm.basics.plain_data import PlainMapping
from afspm.model import Scan, Spectrum
from afspm.storage.formats import FileContent
from afspm.translator.result_files import (
    SCAN,
    Content,
    Entry,
    ResultFiles,
    missing_text,
    modified_ns,
    newest,
    read_result,
)


class FolderFiles(ResultFiles):
    """The running or last measurement and the results of a controller, as files in a folder.

    Attributes:
        pattern: pattern of the file names, as in `Path.glob`.
    """

    pattern: str = "*"
    _before: Entry | None = None
    _of_before: Sequence[tuple[str, int]] = ()
    _outcome: bool | None = None
    _is_given_up = False

    def next_begins(self) -> bool:
        ended = self._kept["ended"]
        self._before, self._is_given_up = ended if ended is not None and ended["what"] == SCAN else None, False
        self._of_before = ()
        return self._before is not None

    def followed(self, now_ns: int, within_s: float) -> bool | None:
        """Return once the outcome of a scan that another one followed before its file was there, else None.

        Args:
            within_s: longest wait for the file, experiment time.
        """
        before, running, outcome = self._before, self._kept["running"], self._outcome
        self._outcome = None
        if self._is_given_up:
            self._before, self._is_given_up = None, False
        # once the next scan is over, a new file is taken for its own
        elif before is not None and (running is None or now_ns >= before["end_ns"] + within_s * NS_PER_S):
            self._is_given_up, outcome = True, False
            if running is not None:
                self._has_none_yet(running)
        return outcome

    def forget(self) -> None:
        self._before, self._is_given_up = None, False
        super().forget()

    def begin(self, what: str, folder: Path, taken: PlainMapping) -> None:
        """Record the start of a measurement.

        Args:
            taken: the place of the measurement: "frame" of a scan, "position" of a spectrum.
        """
        # only files newer than those of now can be its result, but the scan before it may have saved since its end
        newest_ns = self.look(folder) if self._before is None else self._before["newest_ns"]
        self._begins(what, {"folder": str(folder), "newest_ns": newest_ns, **taken})

    def look(self, folder: Path) -> int:
        """Register the files in a folder as no results; return the time of the newest file, in ns."""
        return self.newest_ns(folder, self._files(folder))

    def end(self, now_ns: int) -> None:
        if self._kept["running"] is not None:
            self._ends({"end_ns": now_ns})

    def has_file(self) -> bool:
        """Return True if the running measurement has a file."""
        running = self._kept["running"]
        return running is not None and self._file(running) is not None

    def results(self, now_ns: int) -> list[str]:
        """Assign a complete new file to its measurement, and return the names of the last results, oldest first."""
        self.broken_off = False
        ended, running = self._kept["ended"], self._kept["running"]
        if self._before is not None:
            # a file of the next scan waits until this one's outcome is published, which discards all results
            if running is not None and not self._is_given_up:
                # The state was read before the files: the next scan may have ended and saved in between. If it still
                # runs at the next look, the file is not its own.
                files, seen = self.files_of(self._before), self._of_before
                self._of_before = files
                if files and files == seen and self._take(self._before):
                    self._outcome, self._before, self.broken_off = not self.broken_off, None, False
                    self._has_none_yet(running)
        elif ended is not None and self._take(ended):
            self._kept["ended"] = None
        elif running is not None and running["what"] == SCAN and self._take({**running, "end_ns": now_ns}):
            self._goes_on(running)
        return self._listed()

    def read(self, entry: Entry) -> Content:
        files = [(Path(name), written_ns) for name, written_ns in entry["files"]]
        for path, written_ns in files:
            if modified_ns(path) != written_ns:
                raise FileError("was overwritten or deleted", where=str(path))
        return self._as_set([self.content_of(path) for path, _ in files], entry)

    # --- to be overridden for a controller with other files ---

    def result_name(self, path: Path) -> str:
        return str(path)

    def files_of(self, measured: Entry) -> list[tuple[str, int]]:
        """Return the files of a measurement with their modification times in ns; empty if files are missing."""
        path = self._file(measured)
        return [] if path is None else [(str(path), modified_ns(path))]

    def content_of(self, path: Path) -> FileContent:
        return read_result(path)

    def check(self, path: Path, one: Scan | Spectrum, measured: Entry) -> None:
        """Look at the first scan or spectrum of a new file."""

    def _has_none_yet(self, running: Entry) -> None:
        # all files until now are of the scan before
        running["newest_ns"] = self.look(Path(running["folder"]))

    def _goes_on(self, running: Entry) -> None:
        # the controller repeats scans: only a newer file belongs to the next image
        running["newest_ns"] = self.look(Path(running["folder"]))
        for of_one in ("under_way", "new_frame"):
            running.pop(of_one, None)

    def _take(self, measured: Entry) -> bool:
        # True also for an incomplete scan: there is nothing more to wait for
        files = self.files_of(measured)
        paths = [Path(name) for name, _ in files]
        try:
            contents = [self.content_of(path) for path in paths]
            content = self._as_set(contents, measured) if paths else ()
        except (AfspmError, OSError):
            return False  # still being written
        # a file that changed while it was read is still being written
        if not content or [modified_ns(path) for path in paths] != [written_ns for _, written_ns in files]:
            return False
        if missing := missing_text(content):  # the controller saved an interrupted scan
            self.broken_off, self.missing = True, missing
            return True
        self.check(paths[0], content[0], measured)
        self.newest_ns(Path(measured["folder"]), paths)
        self._add(self.result_name(paths[0]), measured, {"files": [list(one) for one in files]}, content, contents)
        return True

    def _file(self, measured: Entry) -> Path | None:
        return newest(self._files(Path(measured["folder"])), measured["newest_ns"])[1]

    def _files(self, folder: Path) -> list[Path]:
        return list(folder.glob(self.pattern)) if folder.is_dir() else []

    def _as_set(self, files: Sequence[FileContent], measured: Entry) -> Content:
        is_scan = measured["what"] == SCAN
        found = [one for file in files for one in file if isinstance(one, Scan) is is_scan]
        if not found:
            raise FileError(f"the files hold no {measured['what']}")
        return [self.precision.as_set(one, measured) for one in found]
