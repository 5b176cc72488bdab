"""The morning report of a recorded run: `report.html`, one self-contained file, and figures beside it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from afspm.basics.errors import FileError
from afspm.night.run import open_run
from afspm.report import curves, page, pictures, shadow, story
from afspm.storage.atomic import replace_file

__all__ = ["REPORT_FILE", "write"]

REPORT_FILE = "report.html"


def write(folder: str | Path, step: Callable[[str], None] = lambda _: None) -> Path:
    """Write `report.html`, figures that no component has drawn, and a shadow's table; return the path of the report.

    Args:
        folder: the folder of a run, which may still go on; or the folder of all runs, for the newest run.
        step: called with the name of each step of the work, for a line of progress.

    Raises:
        FileError: there is no record, or the report can't be written.
    """
    step("reading the record")
    with open_run(folder) as run:
        contents = story.read(run)
        bad_ns = pictures.bad_ns(run, contents)
        shown = pictures.of_scans(run, pictures.chosen(contents.scans, kept_ns=bad_ns), bad_ns, step)
        target = run.folder / REPORT_FILE
        try:
            step("drawing the figures")
            pictures.draw(run, contents, shown)
            step("writing the page")
            unread = [one.unread for one in shown if one.unread]
            spectra = curves.read(run, unread)
            text = page.html(contents, shown, spectra, pictures.of_figures(run.folder), unread)
            replace_file(target, [text.encode()], synced=False)
            if contents.shadow.agreement:
                replace_file(run.folder / shadow.FILE, [shadow.csv_text(contents.shadow).encode()], synced=False)
        except OSError as error:
            raise FileError(f"can't be written: {error.strerror or error}", where=str(target)) from error
    return target
