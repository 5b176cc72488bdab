"""`afspm drift study`: simulate nights with a progress bar, and print a table of the results."""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from afspm.plugins.drift.workers import processes
from afspm_lab.study import (
    NightSettings,
    SettingsGrid,
    Summary,
    TaskOutcome,
    night,
    on_cluster,
    on_cores,
    summarised,
)
from afspm_lab.study.summary import BY

COLUMNS = {
    BY: "rms",
    "misplaced max": "max",
    "first jump": "jump",
    "unknown at the end": "end",
    "within 95 %": "95 %",
    "refused": "refused",
    "rescans": "again",
    "lost": "lost",
}
LEGEND = """Medians of n nights, lengths in nm; best first.
rms (and its quartiles), max: how far from its place a scan is taken, after the first two hours.
jump: how far the second scan is. end: how wrong the drift is that is believed in the end.
95 %: part of the scans with the truth in their 95 % ellipse, in %.
refused, again: scans that could not be registered, and that were taken again."""


def metrics_of(settings: NightSettings, seed: int) -> Mapping[str, float]:
    return night(settings, seed).metrics()


def run(given: Sequence[str], nights: int, seed: int, cluster: str, jobs: int | None, *, quiet: bool) -> None:
    """Run a study and print its results."""
    combinations = dict(SettingsGrid.of(given).settings())
    tasks = [(settings, seed + k) for k in range(nights) for settings in combinations.values()]
    here = processes(jobs, sum(settings.scans * settings.pixels**2 for settings, _ in tasks))
    labels = list(combinations)
    metrics: dict[str, list[Mapping[str, float]]] = defaultdict(list)
    failed: dict[str, list[str]] = defaultdict(list)
    work = on_cluster(metrics_of, tasks, address=cluster) if cluster else on_cores(metrics_of, tasks, jobs=here)
    for outcome in _shown(work, len(tasks), quiet=quiet):
        label = labels[outcome.index % len(labels)]
        if outcome.error:
            failed[label].append(outcome.error)
        else:
            metrics[label].append(outcome.value)
    show(summarised(labels, metrics, failed), Console(file=sys.stdout, highlight=False))


def _shown(outcomes: Iterator[TaskOutcome], total: int, *, quiet: bool) -> Iterator[TaskOutcome]:
    columns = (TextColumn("nights"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=quiet) as progress:
        task = progress.add_task("nights", total=total)
        for outcome in outcomes:
            progress.advance(task)
            yield outcome


def show(rows: Sequence[Summary], console: Console) -> None:
    """Print the table, its legend, the failed nights, and the verdict on the defaults."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("settings", overflow="fold", min_width=14)
    for name in ("n", COLUMNS[BY], "quartiles", *(name for key, name in COLUMNS.items() if key != BY)):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        style = "bold green" if row.is_best else ""
        cells = (_cell(row, key) for key in COLUMNS if key != BY)
        table.add_row(row.label + _mark(row), str(row.nights), _cell(row, BY), _spread(row), *cells, style=style)
    console.print(table)
    console.print(LEGEND, markup=False)
    for row in rows:
        for error in sorted(set(row.failed)):
            console.print(
                f"{row.label}: {row.failed.count(error)} nights failed: {error}", markup=False, soft_wrap=True
            )
    console.print(_verdict(rows), soft_wrap=True, markup=False)


def _mark(row: Summary) -> str:
    marks = [
        text for text, holds in (("best", row.is_best), ("defaults", row.is_default)) if holds and text != row.label
    ]
    return f" <- {', '.join(marks)}" if marks else ""


def _cell(row: Summary, name: str) -> str:
    if name not in row.quartiles:
        return "-"
    value = row.quartiles[name][1]
    return f"{value:.3g}" if value >= 1.0 else f"{value:.2g}"


def _spread(row: Summary) -> str:
    if not row.nights:
        return "-"
    lower, _, upper = row.quartiles[BY]
    return f"{lower:.3g} … {upper:.3g}"


def _verdict(rows: Sequence[Summary]) -> str:
    (default,) = (row for row in rows if row.is_default)
    best = rows[0]
    if not default.nights:
        return "The defaults did not come to the end of a night"
    if default.is_best:
        return "The defaults are the best."
    figures = f"they are {default.median:.3g} nm off, the best ({best.label}) {_spread(best)} nm."
    return f"The defaults hold: {figures}" if default.holds else f"The defaults do not hold: {figures}"
