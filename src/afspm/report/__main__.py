"""`python -m afspm.report RUN`: the report of a run, in a process of its own."""

from __future__ import annotations

import sys

from afspm.basics.errors import AfspmError
from afspm.report.night_report import write

try:
    write(sys.argv[1])
except AfspmError as error:
    sys.exit(str(error))
