"""`python -m afspm.supervisor.host` runs one Python class of an experiment; its launch line is on standard input.

A run starts all its processes at once, and a component gets its launch line when the scheduler has answered. Until then
it has imported little, so scheduler and translator need not share the processors with the imports of components.
"""

from __future__ import annotations

import sys

from afspm.transport import leave_interrupts_to_parent
from afspm.transport.process.parent import end_within, read_launch_line, take_standard_input

EXIT_GRACE_S = 1.0  # for exit handlers and threads of libraries


def main() -> int:
    """Run the class that the launch line names, and return the exit code."""
    leave_interrupts_to_parent()
    pipe = take_standard_input()
    line = read_launch_line(pipe)
    from afspm.supervisor import hosting  # 200 modules: 0.2 s of a processor, in each process

    return hosting.run(line, pipe)


if __name__ == "__main__":
    exit_code = int(main())
    end_within(EXIT_GRACE_S, exit_code)
    sys.exit(exit_code)
