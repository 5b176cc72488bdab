"""A SECoP server for the instruments of your own Python: QCoDeS, PyMeasure, PyVISA …

Needs nothing but Python 3.9 or newer. It runs in the environment of your instruments, beside afspm or on another
computer:

    from secop_server import Module, serve
    serve({"mf": Module("magnet", "T", get=magnet.field, set=magnet.field, bounds=(-8, 8))}, port=10767)
"""

import contextlib
import json
import socketserver
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

IDENTITY = "ISSE&SINE2020,SECoP,V2019-09-16,v1.0"
IDLE, BUSY, ERROR = 100, 300, 400


@dataclass
class Module:
    """One quantity of an instrument.

    `get()` returns its value now. `set(value)` may take as long as it likes: it runs in a thread of its own, and the
    module is busy until it returns. Without `set` the module can only be read. `is_busy()` says whether the value is
    still on its way after `set` has returned.
    """

    description: str
    unit: str
    get: Callable[[], float]
    set: Callable[[float], None] | None = None
    bounds: tuple[float, float] | None = None
    is_busy: Callable[[], bool] = lambda: False
    target: float | None = None
    worker: threading.Thread | None = None
    error: str = ""
    lock: threading.Lock = field(default_factory=threading.Lock)

    def status(self) -> list:
        if self.error:
            return [ERROR, self.error]
        is_setting = self.worker is not None and self.worker.is_alive()
        return [BUSY, "on its way"] if is_setting or self.is_busy() else [IDLE, ""]

    def change(self, value: float) -> None:
        if self.set is None:
            raise RefusedError("ReadOnly", "this module can only be read")
        if not isinstance(value, (int, float)) or isinstance(value, bool) or value != value:
            raise RefusedError("WrongType", f"{value!r} is no number")
        if self.bounds is not None and not self.bounds[0] <= value <= self.bounds[1]:
            raise RefusedError("RangeError", f"{value} must be between {self.bounds[0]} and {self.bounds[1]}")
        with self.lock:
            if self.worker is not None and self.worker.is_alive():
                raise RefusedError("IsBusy", f"it is on its way to {self.target}")
            self.target, self.error = float(value), ""
            self.worker = threading.Thread(target=self._set, args=(float(value),), daemon=True)
            self.worker.start()

    def _set(self, value: float) -> None:
        try:
            self.set(value)
        except Exception as error:  # of any kind of driver: the client reads it as the status
            self.error = f"{type(error).__name__}: {error}"

    def describe(self) -> dict:
        number = {"type": "double", "unit": self.unit}
        if self.bounds is not None:
            number.update(min=self.bounds[0], max=self.bounds[1])
        codes = {"type": "enum", "members": {"IDLE": IDLE, "BUSY": BUSY, "ERROR": ERROR}}
        status = {"type": "tuple", "members": [codes, {"type": "string"}]}
        found = {"value": ({"type": "double", "unit": self.unit}, True), "status": (status, True)}
        if self.set is not None:
            found["target"] = (number, False)
        accessibles = {name: {"description": name, "datainfo": info, "readonly": readonly}
                       for name, (info, readonly) in found.items()}  # fmt: skip
        kind = "Readable" if self.set is None else "Drivable"
        return {"description": self.description, "interface_classes": [kind], "accessibles": accessibles}


class RefusedError(Exception):
    """A request that is refused: the name of a SECoP error, and the reason."""


class _Session(socketserver.StreamRequestHandler):
    def handle(self) -> None:
        with contextlib.suppress(ConnectionError):  # a client that has gone comes back by a new connection
            for line in self.rfile:
                self.wfile.write((self._reply(line.decode().strip()) + "\n").encode())

    def _reply(self, line: str) -> str:
        action, _, rest = line.partition(" ")
        specifier, _, data = rest.partition(" ")
        try:
            return self._answer(action, specifier, data)
        except Exception as error:  # of any kind of driver: its client must get an answer
            name, text = error.args if isinstance(error, RefusedError) else ("HardwareError", repr(error))
            return f"error_{action} {specifier} {json.dumps([name, text, {}])}"

    def _answer(self, action: str, specifier: str, data: str) -> str:
        modules: dict[str, Module] = self.server.modules
        name, _, accessible = specifier.partition(":")
        if action == "*IDN?":
            return IDENTITY
        if action == "describe":
            told = {"equipment_id": self.server.equipment, "description": self.server.equipment,
                    "modules": {name: module.describe() for name, module in modules.items()}}  # fmt: skip
            return f"describing . {json.dumps(told)}"
        if action in ("activate", "deactivate"):
            return "active" if action == "activate" else "inactive"  # clients ask for values
        if action == "ping":
            return f"pong {specifier} {json.dumps([None, {'t': time.time()}])}"
        if name not in modules:
            raise RefusedError("NoSuchModule", name)
        if action == "change" and accessible == "target":
            modules[name].change(json.loads(data))
            return f"changed {specifier} {self._report(modules[name], accessible)}"
        if action == "read":
            return f"reply {specifier} {self._report(modules[name], accessible or 'value')}"
        raise RefusedError("ProtocolError", f"{action} {specifier} is not supported")

    def _report(self, module: Module, accessible: str) -> str:
        if accessible == "value":
            value = float(module.get())
        elif accessible == "status":
            value = module.status()
        elif accessible == "target" and module.set is not None:
            value = float(module.get()) if module.target is None else module.target
        else:
            raise RefusedError("NoSuchParameter", accessible)
        return json.dumps([value, {"t": time.time()}])


class Server(socketserver.ThreadingTCPServer):
    """Serves modules; `serve_forever()` runs until `shutdown()`."""

    allow_reuse_address = daemon_threads = True

    def __init__(self, modules: dict[str, Module], port: int = 10767, host: str = "127.0.0.1", equipment: str = "mine"):
        super().__init__((host, port), _Session)
        self.modules, self.equipment = modules, equipment


def serve(modules: dict[str, Module], **where) -> None:
    Server(modules, **where).serve_forever()
