"""The record of a run: the journal and one file for each measurement, written from the packet log.

**Theory of operation.** The recorder follows the log and commits its position in it. Its content is read by
`night`, shown by `report`, and drawn by `drawing`.

    comes in      packets of the log, in order
    state         an SQLite journal and one HDF5 file for each measurement; missing parts are rebuilt from the log
    goes out      rows and files, which `night` reads; `run.json` and the lock of a run
    always holds  everything in the record was published; a damaged or missing file is reported and hides no other
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.record.journal import JOURNAL_FILE
    from afspm.record.run_json import ENDED, EXPERIMENT_FILE, STATE_DIR, experiment_name, run_json_or_empty

if TYPE_CHECKING:  # drift writes its mapping beside the files
    from afspm.record.drift_mapping import drift_at, drift_knowledge
    from afspm.record.measured_files import SUFFIX as MEASURED_SUFFIX

if TYPE_CHECKING:  # a recorded run is found and published again
    from afspm.record.run_json import REPLAY_OF, latest_run
    from afspm.record.run_lock import lock_run

if TYPE_CHECKING:  # the page says how a run stands
    from afspm.record.allowed_bands import AllowedBands
    from afspm.record.allowed_bands import allowed_bands as bands_allowed
    from afspm.record.run_json import read_run_json
    from afspm.record.run_lock import cut_off_message, describe_state, goes_on

if TYPE_CHECKING:  # documents of other programs name the fields of a measured file
    from afspm.record.journal import measured_file
    from afspm.record.nexus_writer import field_names

__all__ = [
    "ENDED",
    "EXPERIMENT_FILE",
    "JOURNAL_FILE",
    "MEASURED_SUFFIX",
    "REPLAY_OF",
    "STATE_DIR",
    "AllowedBands",
    "bands_allowed",
    "cut_off_message",
    "describe_state",
    "drift_at",
    "drift_knowledge",
    "experiment_name",
    "field_names",
    "goes_on",
    "latest_run",
    "lock_run",
    "measured_file",
    "read_run_json",
    "run_json_or_empty",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.record.allowed_bands": "AllowedBands",
            "afspm.record.drift_mapping": "drift_at drift_knowledge",
            "afspm.record.journal": "JOURNAL_FILE measured_file",
            "afspm.record.nexus_writer": "field_names",
            "afspm.record.run_json": (
                "ENDED EXPERIMENT_FILE STATE_DIR experiment_name run_json_or_empty REPLAY_OF latest_run read_run_json"
            ),
            "afspm.record.run_lock": "lock_run cut_off_message describe_state goes_on",
        },
        MEASURED_SUFFIX="afspm.record.measured_files.SUFFIX",
        bands_allowed="afspm.record.allowed_bands.allowed_bands",
    )
