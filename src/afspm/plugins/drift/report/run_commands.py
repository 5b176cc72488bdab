"""`afspm compare`: compare runs side by side. `afspm find`: find a remounted sample.

Both commands register scans of different runs, so this module is in the package of the estimators.
"""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from afspm.basics import area_text, position_text, quantity
from afspm.cli import AFTERWARDS, opt

if TYPE_CHECKING:
    from afspm import Run
    from afspm.model import Region
    from afspm.plugins.drift.frame.remount import Remount

compare_app = typer.Typer(rich_markup_mode=None, rich_help_panel=AFTERWARDS)
find_app = typer.Typer(rich_markup_mode=None, rich_help_panel=AFTERWARDS)


@compare_app.command()
def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN RUN…", help="Folders of runs.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The page to write.")] = Path(
        "compare.html"
    ),
) -> None:
    """Compare runs: settings that differ, problems, times, roughness, and the same regions side by side.

    Regions are the same if their scans have the same key, or without keys the same place. Prints a table and writes a
    page with pictures, which alternate and subtract scans of equal size.
    """
    from afspm import open_run
    from afspm.cli import plain_console, plain_table
    from afspm.plugins.drift.report.scan_pair import onto_first
    from afspm.report import compare as compared
    from afspm.report import rows_that_differ, write_comparison

    with ExitStack() as stack:
        found = compared([stack.enter_context(open_run(folder)) for folder in runs], onto_first)
    rows = ([head, *texts] for head, texts in rows_that_differ(found))
    plain_console().print(plain_table(["", *found.names], rows))
    for reason in found.unread:
        typer.echo(f"not compared: {reason}", err=True)
    write_comparison(found, output)
    typer.echo(output)


@find_app.command()
def find(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The run of today.", show_default=False)],
    earlier: Annotated[Path, typer.Argument(metavar="IN", help="A run of an earlier night.", show_default=False)],
    scan: Annotated[int | None, opt("The overview of today, by its number. Default: the largest whole scan.")] = None,
    in_scan: Annotated[int | None, opt("The overview of the earlier night, in the same way.")] = None,
    within: Annotated[
        float, typer.Option(metavar="DEGREES", min=0.1, max=180.0, help="The largest turn of the sample.")
    ] = 180.0,
    as_json: Annotated[bool, typer.Option("--json", help="For programs; in metres and radians.")] = False,
) -> None:
    """Find a remounted sample: today's positions of the places of an earlier night.

    Registers the overview of today with the earlier one, at any angle. Prints offset and angle with standard
    deviations, and the keyed regions of the earlier night in coordinates of today. Exit code 1: not found.
    """
    from afspm import open_run
    from afspm.plugins.drift.frame import remount

    with open_run(run) as today, open_run(earlier) as night:
        now_row, now = remount.overview_of(today, scan)
        row, then = remount.overview_of(night, in_scan)
        found = remount.find(then, now, math.radians(within))
        if as_json:
            _echo_json(found)
        elif found.found:
            simulated = " SIMULATED" if today.simulated or night.simulated else ""
            typer.echo(f"scan {now_row.number} of {today.folder.name} in scan {row.number} of {night.folder.name}")
            _echo_found(found, simulated)
            _echo_regions(found, night)
        else:
            typer.echo(f"not found: {found.reason}")
    if not found.found:
        raise typer.Exit(1)


def _echo_found(found: Remount, simulated: str) -> None:
    offset_m = (found.center_now_m[0] - found.center_m[0], found.center_now_m[1] - found.center_m[1])
    typer.echo(
        f"found{simulated}: turned by {math.degrees(found.angle_rad):.2f}° ± {math.degrees(found.angle_sd_rad):.2f}° "
        f"counter-clockwise about {position_text(found.center_m)}, then moved by {position_text(offset_m)} "
        f"± {quantity(found.sd_m, 'm', 2)}; false with a probability of {_percent(found.wrong)}"
    )


def _percent(share: float) -> str:
    return f"{share:.1%}" if share >= 0.001 else "less than 0.1%"


def _echo_regions(found: Remount, night: Run) -> None:
    from afspm.cli import plain_console, plain_table

    keyed = {row.key: row.region for row in night.scans if row.key and row.region is not None}
    if not keyed:
        return
    heads = ("key", "centre then", "centre today", "±", "size", "angle today")
    rows = [_place_cells(found, key, region) for key, region in keyed.items()]
    plain_console().print(plain_table(heads, rows))


def _place_cells(found: Remount, key: str, region: Region) -> list[str]:
    now = found.region_now(region)
    return [
        key,
        position_text(region.center_m),
        position_text(now.center_m),
        quantity(found.now_sd_m(region.center_m), "m", 2),
        area_text(now.size_m),
        f"{math.degrees(math.remainder(now.angle_rad, math.tau)):.2f}°",
    ]


def _echo_json(found: Remount) -> None:
    import json
    from dataclasses import asdict

    facts = {name: value for name, value in asdict(found).items() if found.found or name == "reason"}
    typer.echo(json.dumps({"found": found.found, **facts}, indent=2, ensure_ascii=False))
