"""For all tests."""

from __future__ import annotations

import os
import signal

from hypothesis import settings

# how long one example takes says more about how busy the computer is than about us
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None)  # new examples each time: AFSPM_EXAMPLES=explore make test
settings.load_profile(os.environ.get("AFSPM_EXAMPLES", "repeatable"))

# a shell that runs the tests in the background ignores Ctrl-C for them, and so would everything that they start
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
