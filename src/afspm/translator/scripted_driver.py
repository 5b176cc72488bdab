"""`ScriptedDriver`: the base of drivers of programs that run scripts and save measurements to files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Generic, Protocol, TypeVar

from afspm.model import Scan, ScopeStatus, Spectrum, names
from afspm.translator.activity import Activity
from afspm.translator.driver import Driver
from afspm.translator.driver_base import connected
from afspm.translator.folder_files import FolderFiles
from afspm.translator.judge import Stated
from afspm.translator.parameters import Value


class ScriptSession(Protocol):
    """A connection to a program whose scripts read and set values by the program's names."""

    def values(self, names: Sequence[str], /) -> Mapping[str, Value]: ...

    def put(self, values: Mapping[str, Value], /) -> None: ...

    def close(self) -> None: ...


S = TypeVar("S", bound=ScriptSession)
A = TypeVar("A", bound=Activity)


class ScriptedDriver(Driver, Generic[S, A]):
    """A driver of a program that runs scripts, and saves each measurement to files in a folder.

    `connect` of the derived class sets `_session`, `_files` and `_activity`.
    """

    program: ClassVar[str]
    """The name of the program, for messages."""
    _session: S | None = None
    _activity: A | None = None
    _files: FolderFiles

    def session(self) -> S:
        """Return the connection to the program. Raises ControllerLost: there is none."""
        return connected(self._session, self.program, self.controller_at)

    @property
    def activity(self) -> A:
        """The running measurement. Raises ControllerLost: there is no connection."""
        return connected(self._activity, self.program, self.controller_at)

    def close(self) -> None:
        if self._activity is not None:
            self._activity.close()
            self._activity = None
        if self._session is not None:
            self._session.close()
            self._session = None

    def status(self) -> ScopeStatus:
        return self.activity.status()

    def set(self, values: Mapping[str, Value]) -> None:
        self.session().put(values)

    def is_read_alone(self, name: str) -> bool:
        """Return whether a row of the parameter table needs `get`, because `values` of the session lacks it."""
        return name == names.CONTROLLER

    def read_rows(self, wanted: Sequence[str]) -> dict[str, Value]:
        """Return values of the parameter table, as many as possible with one request."""
        rows = [self.table[name] for name in wanted if not self.is_read_alone(name)]
        values = self.session().values([row.vendor for row in rows]) if rows else {}
        found = {row.name: row.from_vendor(values[row.vendor]) for row in rows}
        return found | super().read_rows([name for name in wanted if name not in found])

    def results(self) -> Sequence[str]:
        return self._files.results(self.clock.now_ns())

    def followed(self) -> bool | None:
        return self._files.followed(self.clock.now_ns(), self.patience_s(self.common.result_timeout_s))

    def stopped_by_hand(self) -> str:
        return self.activity.why_ended()

    def stated(self, result: str) -> Stated:
        return self._files.stated(result)

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        return self._files.load(result)
