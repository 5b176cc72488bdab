"""For all tests."""

from __future__ import annotations

import signal

from hypothesis import settings

# how long one example takes says more about how busy the computer is than about us
settings.register_profile("afspm", deadline=None)
settings.load_profile("afspm")

# a shell that runs the tests in the background ignores Ctrl-C for them, and so would everything that they start
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
