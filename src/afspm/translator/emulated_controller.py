"""The emulated controller of a run, whose process writes its address to a file that it keeps locked.

The file lies in the folder of the run's state. While the lock is held, the process that wrote the address is alive and
listens there, so no other process can. So a translator that reads the address connects to the emulator of its own run,
and never to a real controller at the vendor's usual port.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING

from afspm.basics.errors import ConfigError
from afspm.basics.file_lock import lock
from afspm.translator.driver_base import ControllerLost

if TYPE_CHECKING:
    from afspm.basics.launch import Launch
    from afspm.translator.driver_base import DriverBase

_LOCKED_BYTES = 1
"""Number of locked bytes before the text: on Windows no other process can read locked bytes."""


@dataclass(frozen=True)
class Listening:
    """One life of an emulator at one address.

    Attributes:
        run: the identity of the run that started it.
        life: a new random text each time that an emulator begins to listen.
    """

    address: str
    run: str
    life: str


class AddressNotice:
    """The published address of an emulated controller, valid while the emulator's process runs.

    Args:
        file: see `notice_file`.
        run: the identity of the run.
    """

    def __init__(self, file: Path, run: str) -> None:
        self._run = run
        self._file = file.open("a+b")
        lock(self._file, wait=True)  # a reader holds the lock for a moment
        self.tell("")

    def tell(self, address: str) -> None:
        """Write the address of the controller; an empty address means that it does not listen."""
        text = json.dumps({"address": address, "run": self._run, "life": os.urandom(8).hex()})
        self._file.truncate(0)
        self._file.write(b" " * _LOCKED_BYTES + text.encode())
        self._file.flush()

    def close(self) -> None:
        self._file.close()


class EmulatedController:
    """The emulator to which a translator connects, found by its notice.

    Args:
        name: name of the emulator's process.
        file: see `notice_file`.
        run: the identity of the run, which must equal the emulator's.
    """

    def __init__(self, name: str, file: Path, run: str) -> None:
        self._name, self._file, self._run = name, file, run
        self._reached: Listening | None = None

    def reach(self, microscope: DriverBase) -> None:
        """Connect to this run's emulator only.

        Raises:
            ControllerLost: the emulator does not listen. Also the errors of `Driver.connect`.
        """
        found = self._reached = self._find()
        microscope.controller_at, microscope.prove = found.address, self.prove
        try:
            microscope.connect()
            self.prove()
        except BaseException:  # raised again: a connection to another controller must not stay open
            microscope.close()
            raise

    def prove(self) -> None:
        """Check that the connected emulator still listens at the same address.

        Raises:
            ControllerLost: the emulator has ended, restarted or moved, or was never reached.
        """
        if self._reached is None or self._find() != self._reached:
            what = "the emulated controller was restarted, or moved to another address"
            raise ControllerLost(what, where=f"[{self._name}]")

    def _find(self) -> Listening:
        where = f"[{self._name}]"
        try:
            with self._file.open("rb") as file:
                if _is_unlocked(file):
                    raise ControllerLost("the emulated controller is not running", where=where)
                file.seek(_LOCKED_BYTES)
                found = Listening(**json.loads(file.read()))
        except FileNotFoundError:
            raise ControllerLost("the emulated controller has not started yet", where=where) from None
        except (OSError, ValueError, TypeError) as error:
            raise ControllerLost(
                f"the address of the emulated controller can't be read: {error}", where=where
            ) from error
        if not found.address:
            raise ControllerLost("the emulated controller is not listening at the moment", where=where)
        if found.run != self._run:
            raise ControllerLost("the emulated controller belongs to another run", where=where)
        return found


def notice_file(state_dir: str, name: str) -> Path:
    """Return the file with the address of the emulator `name`."""
    return Path(state_dir) / f"{name}.controller"


def wired_to(launch: Launch, microscope: DriverBase) -> EmulatedController | None:
    """Return the emulator that a translator must connect to; None for a real controller or a driver without controller.

    Raises:
        ConfigError: the experiment is simulated, and the controller in the settings is not proved to be an emulator; or
            the launch line or the driver lacks the emulator's place.
    """
    if not launch.controller and not (launch.simulated and microscope.controller_at):
        return None
    hint = "for a real controller, leave out `simulated`"
    if not launch.controller:
        what = f"the experiment is simulated, and nothing proves that {microscope.controller_at} is an emulator"
        raise ConfigError(what, where=launch.name, hint=hint)
    if not (launch.state_dir and launch.run):
        raise ConfigError(f"the launch line does not say where [{launch.controller}] listens", where=launch.name)
    if not microscope.controller_at:
        what = f"{type(microscope).__name__} has no controller_at, so it can't be connected to [{launch.controller}]"
        raise ConfigError(what, where=launch.name, hint='see the how-to page "Write a driver"')
    return EmulatedController(launch.controller, notice_file(launch.state_dir, launch.controller), launch.run)


def _is_unlocked(file: IO[bytes]) -> bool:
    # closing the file releases a lock taken here
    try:
        lock(file, shared=True)
    except OSError:
        return False
    return True
