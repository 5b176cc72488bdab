"""The record of a run, derived from the packet log: journal, measured files, overview, exports, report, pictures.

**Theory of operation.** The recorder follows the log and commits its position in it; all other modules read its output.

    comes in      packets of the log, in order
    state         an SQLite journal and one HDF5 file for each measurement; missing parts are rebuilt from the log
    goes out      `Run` (`afspm.open_run`), the report, exports, the overview that the page and `afspm watch` show
    always holds  everything in the record was published; a damaged or missing file is reported and hides no other
"""
