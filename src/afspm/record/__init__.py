"""The record of a run, derived from the packet log: journal, measured files, overview, exports, report, pictures.

**Theory of operation.** The recorder follows the log and commits how far it has come; everything else reads what it
wrote.

    comes in      packets of the log, in order
    state         an SQLite journal and one HDF5 file for each measurement, both made again from the log where they lack
                  something
    goes out      `Run` (`afspm.open_run`), the report, exports, the overview that the page and `afspm watch` show
    always holds  what is in the record was published; a torn or missing file is said to be so and hides nothing else
"""
