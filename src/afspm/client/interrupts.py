"""Ctrl-C and a notebook's stop button during a call: `KeyboardInterrupt` is raised where the call waits."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

from afspm.basics.errors import Interrupted
from afspm.transport import Port
from afspm.transport.process import signals


class Interrupts:
    """A handler of interrupts (Ctrl-C, the stop button of a notebook) during calls over one port.

    An interrupt is raised where a call waits, so that no request or answer is left half done. In a program that handles
    or ignores SIGINT itself, as components do, Ctrl-C has no effect here.
    """

    def __init__(self, port: Port) -> None:
        self._port = port
        self._is_heeded = False
        self._is_deferred = False
        self._has_come = False

    @contextmanager
    def heeded(self) -> Iterator[None]:
        """Raise KeyboardInterrupt only where the block calls `heed`, and at the end of the block."""
        # components handle SIGINT themselves; an outer block handles what comes between two inner ones
        if self._is_heeded or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
            yield
            return
        self._is_heeded, self._has_come = True, False
        try:
            with signals.caught(self._come, self._port.wakeup_fileno(), signals.CTRL_C):
                yield
                self.heed()
        finally:
            self._is_heeded = False

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Ignore interrupts during the block, which must be short; they are not raised later."""
        self._is_deferred = True
        try:
            yield
        finally:
            self._is_deferred = self._has_come = False

    def heed(self) -> None:
        """Raise Interrupted, a KeyboardInterrupt, if an interrupt has come and is not deferred."""
        if self._has_come and not self._is_deferred:
            self._has_come = False
            raise Interrupted

    def interrupt(self) -> None:
        """Interrupt the present call, as Ctrl-C does. Thread-safe."""
        self._has_come = True
        self._port.wake_up()

    def _come(self, _number: int) -> None:
        self._has_come = True
