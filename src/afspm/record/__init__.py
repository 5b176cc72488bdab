"""The record of a run, derived from the packet log: journal, measured files, overview, exports, report, pictures.

**Theory of operation.** The recorder follows the log and commits its position in it; all other modules read its output.

    comes in      packets of the log, in order
    state         an SQLite journal and one HDF5 file for each measurement; missing parts are rebuilt from the log
    goes out      `Run` (`afspm.open_run`), the report, exports, the overview that the page and `afspm watch` show
    always holds  everything in the record was published; a damaged or missing file is reported and hides no other
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.record.drawing.raster import ValueRange, indices, png, shared_range, value_range
    from afspm.record.journal import JOURNAL_FILE
    from afspm.record.overview import ScanSummary
    from afspm.record.packets import RecordPlayback
    from afspm.record.plotting import draw_scale_bar, save_figure
    from afspm.record.report.markup import document, section, table
    from afspm.record.run_json import ENDED, EXPERIMENT_FILE, STATE_DIR, experiment_name, run_json_or_empty
    from afspm.record.tables import ScanRow, SpectrumRow

if TYPE_CHECKING:  # drift writes into a night: its mapping, its comparison, its pictures
    from afspm.record.comparison import compare
    from afspm.record.comparison_page import rows_that_differ
    from afspm.record.comparison_page import write as write_comparison
    from afspm.record.drift_mapping import drift_at, drift_knowledge
    from afspm.record.measured_files import SUFFIX as MEASURED_SUFFIX
    from afspm.record.report.pictures import OFFSET, is_ours, topography

if TYPE_CHECKING:  # the page shows a night while it goes on
    from afspm.record.allowed_bands import AllowedBands, instrument_curves
    from afspm.record.allowed_bands import allowed_bands as bands_allowed
    from afspm.record.drawing.chart import Axis, Curve
    from afspm.record.drawing.curves import profile, thinned
    from afspm.record.drawing.palette import DIVERGING, LEVELS, PALETTES
    from afspm.record.drawing.raster import Contrast
    from afspm.record.drawing.timeline import CSS as TIMELINE_CSS
    from afspm.record.drawing.timeline import TimelineRow, timeline_html, tint_class
    from afspm.record.expected_end import Plans, plans_of
    from afspm.record.overview import OVER, ROUTINE, DriftPoint, FoundPlace, RunningScan, SpectrumSummary
    from afspm.record.report import REPORT_FILE
    from afspm.record.report import write as write_report
    from afspm.record.timeline import Span, Timeline

if TYPE_CHECKING:  # documents of other programs name the fields of a measured file
    from afspm.record.journal import measured_file
    from afspm.record.nexus_writer import field_names

if TYPE_CHECKING:  # one plug-in draws or completes nights with it, and another may
    from afspm.record.drawing.image_html import round_length_m
    from afspm.record.drawing.image_html import shown as shown_image
    from afspm.record.drawing.palette import CATEGORICAL, PROBLEM
    from afspm.record.drawing.raster import reduced
    from afspm.record.overview import Overview
    from afspm.record.plotting import gold
    from afspm.record.report import shadow as shadow_report
    from afspm.record.report.story import RunStory
    from afspm.record.report.story import read as read_story
    from afspm.record.run_json import REPLAY_OF, RUN_FILE, latest_run, read_run_json
    from afspm.record.run_lock import cut_off_message, describe_state, goes_on, lock_run

__all__ = [
    "CATEGORICAL",
    "DIVERGING",
    "ENDED",
    "EXPERIMENT_FILE",
    "JOURNAL_FILE",
    "LEVELS",
    "MEASURED_SUFFIX",
    "OFFSET",
    "OVER",
    "PALETTES",
    "PROBLEM",
    "REPLAY_OF",
    "REPORT_FILE",
    "ROUTINE",
    "RUN_FILE",
    "STATE_DIR",
    "TIMELINE_CSS",
    "AllowedBands",
    "Axis",
    "Contrast",
    "Curve",
    "DriftPoint",
    "FoundPlace",
    "Overview",
    "Plans",
    "RecordPlayback",
    "RunStory",
    "RunningScan",
    "ScanRow",
    "ScanSummary",
    "Span",
    "SpectrumRow",
    "SpectrumSummary",
    "Timeline",
    "TimelineRow",
    "ValueRange",
    "bands_allowed",
    "compare",
    "cut_off_message",
    "describe_state",
    "document",
    "draw_scale_bar",
    "drift_at",
    "drift_knowledge",
    "experiment_name",
    "field_names",
    "goes_on",
    "gold",
    "indices",
    "instrument_curves",
    "is_ours",
    "latest_run",
    "lock_run",
    "measured_file",
    "plans_of",
    "png",
    "profile",
    "read_run_json",
    "read_story",
    "reduced",
    "round_length_m",
    "rows_that_differ",
    "run_json_or_empty",
    "save_figure",
    "section",
    "shadow_report",
    "shared_range",
    "shown_image",
    "table",
    "thinned",
    "timeline_html",
    "tint_class",
    "topography",
    "value_range",
    "write_comparison",
    "write_report",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(__name__)
