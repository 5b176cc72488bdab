"""Keys for the processes of a run: from the keys folder, or made for this run. Each process gets only its own keys."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from afspm.basics.addresses import connectable, reaches
from afspm.basics.launch import Sockets
from afspm.client.connect import GUEST_KEYS
from afspm.experiment import Experiment, ProcessStart, Role
from afspm.model.events import SUPERVISOR
from afspm.record.run_json import STATE_DIR
from afspm.storage.atomic import replace_file
from afspm.storage.disk import run_bounded
from afspm.transport import keys
from afspm.transport.keys import GUEST, Keys

# a hanging disk must not keep the run from starting or ending
WRITTEN_WITHIN_S = 5.0


@dataclass(frozen=True)
class KeyHandout:
    """The processes to start, with their keys.

    Attributes:
        guest, supervisor: keys for programs that join the run, and for the supervisor's reporter, as in launch lines;
            None: the file gives a keys folder, or there are no keys.
    """

    starts: Sequence[ProcessStart]
    guest: Mapping[str, object] | None = None
    supervisor: Mapping[str, object] | None = None

    @contextmanager
    def laid_down(self, folder: Path) -> Iterator[None]:
        """Keep the guests' keys in the run's folder during the block; errors of the disk are ignored."""
        file = folder / STATE_DIR / GUEST_KEYS
        if self.guest is not None:
            text = json.dumps(self.guest).encode()
            with contextlib.suppress(OSError):
                run_bounded(lambda: replace_file(file, [text], mode=0o600), WRITTEN_WITHIN_S)
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                run_bounded(lambda: file.unlink(missing_ok=True), WRITTEN_WITHIN_S)


def hand_over(experiment: Experiment, starts: Sequence[ProcessStart]) -> KeyHandout:
    """Return the processes to start, each with its keys.

    Raises:
        ConfigError: a key of the file is missing, or readable for other users.
    """
    if experiment.keys_folder is not None:
        return KeyHandout(
            [_with_keys(start, _keys_of_file(experiment, start), _scheduler(experiment)) for start in starts]
        )
    security = experiment.resolved.sections.security
    encrypted = {} if security.insecure else _encrypted(experiment, starts)
    return _with_new_keys(starts, encrypted, _scheduler(experiment)) if encrypted else KeyHandout(starts)


def _scheduler(experiment: Experiment) -> str:
    return next((part.name for part in experiment.resolved.with_role(Role.SCHEDULER)), "")


def _with_keys(start: ProcessStart, own: Keys | None, scheduler: str) -> ProcessStart:
    # a translator obeys the scheduler of this name alone
    if own is None:
        return start
    return replace(start, launch=replace(start.launch, keys={**own.as_launch(), "scheduler": scheduler}))


def _keys_of_file(experiment: Experiment, start: ProcessStart) -> Keys | None:
    # a Python process that binds nothing needs the public keys of its servers alone
    launch = start.launch
    own = keys.from_launch(launch.name, launch.keys)
    if own is None or launch.sockets.publish or launch.sockets.serve or start.command:
        return own
    known = {key: name for key, name in own.peers.items() if name in own.servers.values()}
    return replace(own, peers=known, folder=None)


def _encrypted(experiment: Experiment, starts: Sequence[ProcessStart]) -> dict[str, str]:
    # Encrypted are sockets for requests, and publishers that other users of this computer can reach, but only where
    # every process that connects is started here: no other gets the keys of this run.
    slots = experiment.resolved.net.slots
    here = {start.launch.name for start in starts}
    complete = here >= set(experiment.component_names)
    found: dict[str, str] = {}
    schedulers = [start for start in starts if start.role is Role.SCHEDULER and not start.command]
    for start in schedulers:
        slot = slots.get(f"{start.launch.name}/serve")
        others_know = slot is not None and slot.address is not None
        if start.launch.sockets.serve and (complete or not others_know):
            found[connectable(start.launch.sockets.serve)] = start.launch.name
    for start in starts:
        if start.role is Role.TRANSLATOR and not start.command and schedulers and start.launch.sockets.serve:
            found[connectable(start.launch.sockets.serve)] = start.launch.name
    guarding = set(found.values())
    if not guarding.issuperset(start.launch.name for start in schedulers):
        return found  # the scheduler's subscribers are started elsewhere, and don't get these keys
    bound = [start.launch.sockets.publish for start in starts] + [start.launch.sockets.serve for start in starts]
    all_ports = not any(keys.is_private(address) for address in bound if address is not None)
    for start in starts:
        publish, name = start.launch.sockets.publish, start.launch.name
        # a program in another language encrypts all its sockets or none; a translator none, unless the file has keys
        can_encrypt = name in guarding or (start.role is Role.COMPONENT and (all_ports or not start.command))
        if publish is not None and not keys.is_private(publish) and can_encrypt:
            found[connectable(publish)] = name
    return found


def _with_new_keys(starts: Sequence[ProcessStart], encrypted: Mapping[str, str], scheduler: str) -> KeyHandout:
    pairs = {name: keys.pair() for name in [*(start.launch.name for start in starts), SUPERVISOR, GUEST]}
    public = {name: pair[0] for name, pair in pairs.items()}

    def of(name: str, sockets: Sockets, role: Role = Role.COMPONENT, *, foreign: bool = False) -> Keys | None:
        connected = [address for address in (sockets.control, *sockets.subscribe) if address is not None]
        servers = {
            address: owner for address in connected for bound, owner in encrypted.items() if reaches(address, bound)
        }
        guards = name in encrypted.values()
        if not servers and not guards:
            return None
        asking = [] if not guards else subscribing(sockets) if role is Role.TRANSLATOR else [*pairs]
        peers = {public[one]: one for one in [*asking, *servers.values()]}
        return Keys(name, *pairs[name], peers, servers, everywhere=foreign and guards, guards=guards)

    def subscribing(sockets: Sockets) -> list[str]:
        bound = sockets.publish or ""
        found = [start.launch for start in starts if any(reaches(one, bound) for one in start.launch.sockets.subscribe)]
        return [scheduler, *(launch.name for launch in found)]

    handed = [
        _with_keys(
            start, of(start.launch.name, start.launch.sockets, start.role, foreign=bool(start.command)), scheduler
        )
        for start in starts
    ]
    asked = tuple(address for address, owner in encrypted.items() if owner == scheduler)
    guest = Sockets(subscribe=asked)  # connects to all publishers
    outside = [None if (one := of(name, guest)) is None else one.as_launch() for name in (GUEST, SUPERVISOR)]
    return KeyHandout(handed, *outside)
