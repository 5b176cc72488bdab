"""What is there from one connecting to the next: both connections, the release, and the modules that are open."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Final

from afspm.errors import AfspmError
from afspm.microscopes.nanonis.link import Link
from afspm.microscopes.nanonis.listener import Listener
from afspm.microscopes.nanonis.protocol import NanonisError

MODULES: Final = {"IV": "BiasSpectr", "force": "ZSpectr"}
APPROACH: Final = "AutoApproach"
_WITHOUT_VERSION: Final = 10862
"""The release to take where the software can't tell its own."""


class Session:
    """Two connections to Nanonis: one for questions that are answered at once, one for what takes its time.

    Args:
        addresses: of both; the same one only where a port serves several clients.
        timeout_s: for an answer, in real time.
        release: None: Nanonis is asked for it.
        prove: called once each connection stands, before anything is asked.
        wake: called, from another thread, when `listener` has heard something.

    Attributes:
        controller: its name and version, for a person.
        opened: the modules that can be used: Nanonis has those that were bought, and they answer once they are open.

    Raises:
        ControllerLost.
    """

    def __init__(
        self,
        addresses: list[tuple[str, int]],
        timeout_s: float,
        release: int | None,
        *,
        prove: Callable[[], None],
        monotonic_s: Callable[[], float],
        wake: Callable[[], None],
        log: logging.Logger,
    ) -> None:
        self._log = log
        self._link = Link(addresses[0], timeout_s, monotonic_s)
        self._listener: Listener | None = None
        try:
            prove()
            self.controller = f"Nanonis, release {release}"
            self._link.release = release or self._found_release()
            self.opened = {module for module in (*MODULES.values(), APPROACH) if self._open(module)}
            second = Link(addresses[-1], timeout_s, monotonic_s, self._link.release)
            self._listener = self.listener = Listener(second, wake)
            prove()
        except AfspmError:
            self.close()
            raise

    def ask(self, name: str, *arguments: Any) -> tuple[Any, ...]:
        """Call a function that answers at once."""
        return self._link.ask(name, *arguments)

    def close(self) -> None:
        """End both connections."""
        if self._listener is not None:
            self._listener.close()
        self._link.close()

    def _found_release(self) -> int:
        try:
            product, version, host_release, engine_release = self.ask("Util.VersionGet")
        except NanonisError:
            self.controller = f"Nanonis, taken as release {_WITHOUT_VERSION}"
            self._log.warning("Nanonis can't tell its release: taken as %d (set release)", _WITHOUT_VERSION)
            return _WITHOUT_VERSION
        self.controller = f"{product} {version}, release {host_release}"
        self._log.info("%s (real-time engine %d)", self.controller, engine_release)
        return int(host_release)

    def _open(self, module: str) -> bool:
        try:
            self.ask(f"{module}.Open")
        except NanonisError as error:
            self._log.warning("%s can't be used: %s", module, error)
            return False
        return True
