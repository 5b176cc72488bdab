"""Estimators as a user may write them, for the worker."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import numpy as np

from afspm.plugins.drift.registration import DriftScan, Prior, Registration


class Brightest:
    """Locates the brightest pixel in both scans."""

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        a, b = (np.array(np.unravel_index(np.argmax(one.values), one.values.shape))[::-1] for one in (reference, scan))
        shift_m = (b - a) * np.array(scan.pixel_m) + np.subtract(scan.region.center_m, reference.region.center_m)
        center_m = np.array(reference.region.center_m)
        return Registration(True, "", shift_m, np.eye(2) * 1e-20, np.zeros((2, 2)), center_m)


class Dies:
    """Ends its process."""

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        os._exit(7)


class Hangs:
    """Never returns."""

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        threading.Event().wait()
        raise AssertionError


class Forks(Brightest):
    """Leaves a child process behind that holds all pipes of the worker, and hangs. The child writes to $FORKED."""

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        if os.fork() == 0:
            Path(os.environ["FORKED"]).write_text("forked", encoding="utf-8")
            threading.Event().wait(15.0)
            os._exit(0)
        threading.Event().wait()
        raise AssertionError


class Talks(Brightest):
    """Prints, as a user's code may."""

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        print("a word to standard output")  # noqa: T201
        return super().register(reference, scan, prior)
