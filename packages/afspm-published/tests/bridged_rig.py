"""Programs of the published implementation beside afspm's, with the bridge in its own process between them."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from scheduler_rig import Component, Rig

from afspm.basics.launch import Launch, Sockets
from afspm.supervisor.ports import FreePorts

PACKAGE = "afspm_published"


class Bridge:
    """A process of the bridge."""

    def __init__(self, class_: str, sockets: Sockets, settings: dict[str, Any], folder: Path, keys: Any = None) -> None:
        launch = Launch("bridge", f"{PACKAGE}.{class_}", settings, sockets, state_dir=str(folder / "state"), keys=keys)
        self.process = subprocess.Popen([sys.executable, "-m", "afspm.supervisor.host"], stdin=subprocess.PIPE)
        assert self.process.stdin is not None
        self.process.stdin.write(launch.to_json().encode() + b"\n")
        self.process.stdin.flush()

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


class BridgedRig(Rig):
    """A rig whose addresses are known to the published programs; afspm's programs use others, behind the bridge."""

    def __init__(self, folder: Path, keys_folder: Path | None = None) -> None:
        super().__init__(folder, keys_folder)
        ports = FreePorts()
        self.inside = Sockets(ports.address(), (ports.address(),), ports.address(), ports.address())
        self.bridges: list[Bridge] = []
        self.translator_settings: dict[str, Any] = {}

    def launch(self) -> Launch:
        launch = super().launch()
        source = self.source if self.translator is not None else (self.inside.subscribe[0], str(self.inside.control))
        sockets = Sockets(self.inside.publish, (source[0],), self.inside.serve, source[1])
        return replace(launch, sockets=sockets)

    def start(self) -> None:
        """Start the rig and its bridges, one of them to the published translator if afspm's is not part of it."""
        super().start()
        inside = self.inside
        sockets = Sockets(subscribe=(str(inside.publish),), control=inside.serve)
        self.bridge("peers.PublishedPeers", sockets, serve=self.serve, publish=self.publish)
        if self.translator is None:
            sockets = Sockets(publish=inside.subscribe[0], serve=inside.control)
            settings = self.translator_settings
            self.bridge(
                "translator.PublishedTranslator", sockets, serve=self.source[1], publish=self.source[0], **settings
            )

    def component(self, name: str, envelopes: list[str] | None = None, owner: str = "") -> Component:
        """Return a component; with the bridge to the published scheduler if afspm's is not part of it."""
        inside = self.inside
        if self.process is None:
            sockets = Sockets(publish=inside.publish, serve=inside.serve)
            self.bridge("scheduler.PublishedScheduler", sockets, serve=self.serve, publish=self.publish)
        outside = self.publish, self.serve
        self.publish, self.serve = str(inside.publish), str(inside.serve)
        try:
            component = Component(self, name, envelopes, owner)
        finally:
            self.publish, self.serve = outside
        self.components.append(component)
        self.until(component.connected)
        return component

    def bridge(self, class_: str, sockets: Sockets, **settings: Any) -> None:
        addresses = (*sockets.subscribe, str(sockets.control))
        keys = self._keys_folder and {"folder": str(self._keys_folder), **dict.fromkeys(addresses, "scheduler")}
        self.bridges.append(Bridge(class_, sockets, settings, self._folder, keys))

    def close(self) -> None:
        super().close()
        for bridge in self.bridges:
            bridge.close()
