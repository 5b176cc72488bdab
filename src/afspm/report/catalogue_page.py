"""The catalogue of runs as one HTML page: a card for each run, with pictures and a link to the report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import UTC
from html import escape
from pathlib import Path
from typing import Final
from urllib.parse import quote

from afspm.basics.errors import FileError
from afspm.basics.formatting import counted, period_text
from afspm.drawing.image_html import data_url
from afspm.night.catalogue import RunSummary
from afspm.night.run import open_run
from afspm.report import pictures
from afspm.report.markup import document, section
from afspm.storage.atomic import replace_file

PAGE_FILE: Final = "index.html"
_PICTURES: Final = 4
"""The largest number of shown scans of a run, evenly selected."""
_ABOUT: Final = ("sample", "person", "project")
_REPORT: Final = "report.html"
_CSS: Final = """
.runs{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(20rem,100%),1fr));gap:1rem}
.runs article{background:var(--panel);border-radius:.5rem;overflow:hidden;display:flex;flex-direction:column}
.runs span.scans{display:grid;grid-template-columns:repeat(4,1fr);gap:2px}
.runs img{width:100%;aspect-ratio:1;object-fit:cover;display:block}
.runs div{padding:.6rem .9rem}.runs h3{margin:0;overflow-wrap:anywhere}.runs p{margin:.2rem 0}
.runs a{color:inherit;text-decoration:none}.runs a:hover h3{text-decoration:underline}.runs b{color:var(--problem)}
"""


def write_page(root: Path, runs: Sequence[RunSummary]) -> Path:
    """Write `index.html` into the folder of all runs, and return its path; reports are linked, not copied."""
    cards = "".join(_card(root, run) for run in runs)
    body = f"<header><h1>{escape(root.resolve().name)}</h1><p>{counted(len(runs), 'run')}</p></header>"
    body += section("", f'<div class="runs">{cards}</div>')
    target = root / PAGE_FILE
    replace_file(target, [document("Runs", body, _CSS).encode()], synced=False)
    return target


def _card(root: Path, run: RunSummary) -> str:
    folder, link = root / run.folder, quote(run.folder)
    shown = "".join(f'<img src="{url}" alt="">' for url in _pictures(folder)) if run.scans else ""
    shown = f'<span class="scans">{shown}</span>' if shown else ""
    target = f"{link}/{_REPORT}" if (folder / _REPORT).is_file() else f"{link}/"
    badge = ' <span class="badge">SIMULATED</span>' if run.simulated else ""
    lines = "".join(f"<p>{line}</p>" for line in _lines(run) if line)
    return f'<article><a href="{target}">{shown}<div><h3>{escape(run.name)}{badge}</h3>{lines}</div></a></article>'


def _pictures(folder: Path) -> Iterator[str]:
    with suppress(FileError), open_run(folder) as run:
        whole = [row for row in run.scans if not row.interrupted]
        for picture in pictures.of_scans(run, pictures.chosen(whole, _PICTURES)):
            if picture.image is not None:
                yield data_url(picture.image.image)


def _lines(run: RunSummary) -> list[str]:
    if run.damage:
        return [f"<b>{escape(run.damage)}</b>"]
    about = " · ".join(
        filter(None, (*(run.metadata.get(name) for name in _ABOUT), "" if run.simulated else run.microscope))
    )
    period = "" if run.began_ns is None or run.ended_ns is None else period_text(run.began_ns, run.ended_ns, UTC)
    problems = f"<b>{escape(', '.join(run.problems))}</b>" if run.problems else ""
    return [
        escape(about),
        escape(period),
        escape(f"{run.measured}; {run.state}"),
        problems,
        *(escape(f"“{note}”") for note in run.notes),
    ]
