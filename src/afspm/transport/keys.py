"""CURVE keys: one pair for each component in a folder of certificates, and the check of peers' keys.

    keys/public/<name>.key            copied to every computer that takes part
    keys/private/<name>.key_secret    only where the component runs

The files have the format of ZeroMQ's own tools (ZPL), so that peers of other makes can use them.
"""

from __future__ import annotations

import os
import re
import secrets
import stat
import sys
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import zmq
from zmq.utils import z85

from afspm.basics.errors import ConfigError
from afspm.basics.plain_data import Plain, PlainMapping
from afspm.model import component_of
from afspm.transport.polling import WakeUp

GUEST = "guest"
"""Owner of the key for notebooks and terminal commands of a run with its own keys; also valid under other names."""
MARK = b"\0"
"""Separates the name from the random part of a socket's identity."""
DOMAIN = b"afspm"
_ZAP_ADDRESS = "inproc://zeromq.zap.01"
_NAME = re.compile(r"[A-Za-z0-9_. +-]{1,100}")
_ENTRY = re.compile(r'^\s*(public-key|secret-key)\s*=\s*"([^"]{40})"\s*$', re.MULTILINE)


@dataclass(frozen=True)
class Keys:
    """The key pair of a process, and the public keys of its peers.

    Attributes:
        name: owner of the pair.
        public, secret: the pair, as Z85 text.
        peers: accepted public keys, with the names of their owners.
        servers: names of the peers that bind the addresses to connect to, by address.
        folder: folder to which public keys may be added later; None: no further keys.
        everywhere: whether every socket is encrypted. If False (all on one computer), only connections to `servers` are
            encrypted, and with `guards` some bound sockets.
        guards: whether bound sockets are encrypted if they receive requests, or are not unix sockets.
    """

    name: str
    public: bytes
    secret: bytes = field(repr=False)
    peers: Mapping[bytes, str]
    servers: Mapping[str, str] = field(default_factory=dict)
    folder: Path | None = None
    everywhere: bool = True
    guards: bool = True

    def server_key(self, address: str) -> bytes | None:
        """Return the public key of the process that binds `address`; None for a plain connection.

        Raises:
            ConfigError: the owner of the address, or its key, is unknown.
        """
        name = self.servers.get(address)
        if name is None and not self.everywhere:
            return None
        if name is None:
            raise ConfigError(
                "no key is set for the process at this address", where=address,
                hint="name the owner of this address in the keys of this process",
            )  # fmt: skip
        for key, owner in self.peers.items():
            if owner == name:
                return key
        raise ConfigError(
            f"there is no public key of {name!r}", where=address, hint=f"afspm keys can make one: {name}.key"
        )

    def binds_encrypted(self, address: str, *, requests: bool) -> bool:
        """Return whether a socket bound at `address` is encrypted; `requests`: the socket receives requests.

        Only the owner of the folder reaches a unix socket. Requests need keys even there: a sender must prove its name.
        """
        return self.everywhere or (self.guards and (requests or not is_private(address)))

    def user_as(self, user: str | None, name: str) -> str | None:
        """Return the user for messages under `name` over a connection of the key of `user`.

        The guests' key counts as the key of any component that has none of its own.
        """
        component = component_of(name)
        return component if user == GUEST and component not in self.peers.values() else user

    def as_launch(self) -> Plain:
        """Return the entries for a launch line, see `from_launch`."""
        return {
            "name": self.name,
            "public": self.public.decode(),
            "secret": self.secret.decode(),
            "peers": {key.decode(): name for key, name in self.peers.items()},
            "servers": dict(self.servers),
            "folder": None if self.folder is None else str(self.folder),
            "everywhere": self.everywhere,
            "guards": self.guards,
        }


def is_private(address: str) -> bool:
    """Return whether the operating system keeps other users from an address."""
    return address.startswith(("ipc://", "inproc://"))


def routing_id(name: str) -> bytes:
    """Return a new, random socket identity for requests under a name.

    A ROUTER socket sends answers to the newest connection of an identity. With the bare name as identity, a second
    process of the same name would cut off the first.
    """
    return name.encode() + MARK + secrets.token_hex(8).encode()


def load(folder: str | Path, name: str, servers: Mapping[str, str] | None = None) -> Keys:
    """Return the keys of the component `name` from a folder made by `generate`.

    Raises:
        ConfigError: a folder or key is missing, a file is not a certificate, or other users may read the secret key.
    """
    folder = Path(folder)
    secret_file = folder / "private" / f"{_checked(name)}.key_secret"
    if not secret_file.exists() and (folder / "public" / f"{name}.key").exists():
        raise ConfigError(
            f"the secret key of {name!r} is missing; only the public one exists",
            where=str(secret_file),
            hint=f"copy it from where it was made; if lost, delete public/{name}.key everywhere and make another",
        )
    entries = _read(secret_file, name)
    if "secret-key" not in entries:
        raise ConfigError("this file holds no secret key", where=str(secret_file))
    require_private(secret_file)
    public = folder / "public"
    return Keys(
        name, entries["public-key"], entries["secret-key"], public_keys(public, name), dict(servers or {}), public
    )


def require_private(file: Path) -> None:
    """Refuse a secret key that other users may read; no check on Windows, which has no file modes.

    Raises:
        ConfigError: the mode of the file lets other users read it.
    """
    mode = file.stat().st_mode if sys.platform != "win32" else 0
    if mode & 0o077:
        raise ConfigError(
            f"other users may read this secret key: its mode is {stat.S_IMODE(mode):04o}", where=str(file),
            hint=f"if none has read it: chmod 600 {file.name}; otherwise make a new key",
        )  # fmt: skip


def public_keys(folder: Path, name: str) -> dict[bytes, str]:
    """Return the public keys in a folder, with the names of their owners, for the process `name`.

    Raises:
        ConfigError: a file is not a certificate.
    """
    files = sorted(folder.glob("*.key"))
    return {_read(file, name)["public-key"]: file.name.removesuffix(".key") for file in files}


def from_launch(name: str, entries: PlainMapping | None) -> Keys | None:
    """Return the keys in a launch line, given whole (`Keys.as_launch`) or by folder and names; None without keys.

    A component that acts for a person ("dashboard:Ada") uses its own key.

    Args:
        entries: the result of `as_launch`; or `{"folder": …, "<address>": "<name of the binding process>", …}`.

    Raises:
        ConfigError: as for `load`, for keys in a folder.
    """
    if not entries:
        return None
    if "secret" in entries:
        folder = entries["folder"]
        return Keys(
            str(entries["name"]),
            str(entries["public"]).encode(),
            str(entries["secret"]).encode(),
            {str(key).encode(): str(owner) for key, owner in entries["peers"].items()},
            dict(entries["servers"]),
            None if folder is None else Path(folder),
            bool(entries["everywhere"]),
            bool(entries["guards"]),
        )
    if "folder" not in entries:
        return None
    servers = {address: owner for address, owner in entries.items() if "://" in address}
    return load(entries["folder"], component_of(name), servers)


def with_server(name: str, entries: PlainMapping | None, address: str, key: bytes) -> Plain:
    """Return the launch line's keys with one more server: the supervisor's heartbeat socket.

    Args:
        name: name of the process; without keys, the process gets a new pair.
    """
    own = from_launch(name, entries) or Keys(name, *pair(), {}, everywhere=False, guards=False)
    owner = f"heartbeat of {name}"
    return {
        **(entries or {}),
        **replace(own, peers={**own.peers, key: owner}, servers={**own.servers, address: owner}).as_launch(),
    }


def pair() -> tuple[bytes, bytes]:
    return zmq.curve_keypair()


def generate(folder: str | Path, names: Iterable[str]) -> list[Path]:
    """Make the missing key pairs of `names`; return the files written.

    Existing keys stay: a new component joins without changes on the other computers. A public key without its secret
    key belongs to a process on another computer. A lost public key is restored from the file of the secret key.

    Raises:
        ConfigError: a name is not valid for a file, or a file is not a certificate.
    """
    folder = Path(folder)
    written = []
    (folder / "public").mkdir(parents=True, exist_ok=True)
    (folder / "private").mkdir(mode=0o700, exist_ok=True)
    for name in names:
        public_file = folder / "public" / f"{_checked(name)}.key"
        secret_file = folder / "private" / f"{name}.key_secret"
        if public_file.exists():
            continue
        if secret_file.exists():
            public = _read(secret_file, name)["public-key"]
        else:
            public, secret = pair()
            _write(secret_file, {"public-key": public, "secret-key": secret}, mode=0o600)
            written.append(secret_file)
        _write(public_file, {"public-key": public}, mode=0o644)
        written.append(public_file)
    return written


def _checked(name: str) -> str:
    if not _NAME.fullmatch(name) or name.startswith("."):
        raise ConfigError(f"{name!r} can't be the name of a key file", hint="letters, digits, - _ + . and spaces")
    return name


def _write(file: Path, entries: Mapping[str, bytes], *, mode: int) -> None:
    lines = [f'    {key} = "{value.decode()}"' for key, value in entries.items()]
    text = "\n".join(["#   ZeroMQ CURVE certificate of afspm. Do not share a secret key.", "metadata", "curve",
                      *lines, ""])  # fmt: skip
    # the mode is set at creation: a later chmod would leave the secret readable for a moment
    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode)
    with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
        stream.write(text)


def _read(file: Path, name: str) -> dict[str, bytes]:
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"the key can't be read: {error}", where=str(file), hint=f"make it with: afspm keys FILE --also {name}"
        ) from error
    entries = {key: value.encode() for key, value in _ENTRY.findall(text)}
    if "public-key" not in entries:
        raise ConfigError("the file is not a certificate: it has no public key", where=str(file))
    return entries


class Authenticator:
    """The handler of ZeroMQ's authentication protocol (ZAP, RFC 27) for CURVE keys, in its own thread.

    Each answer accepts or refuses a key. It holds the name of the key's owner, which becomes the "User-Id" of every
    message of the connection. Keys may be added while the experiment runs: at an unknown key, a changed folder is read
    again.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], keys: Keys) -> None:
        self._keys = keys
        self._names = {z85.decode(key): name.encode() for key, name in keys.peers.items()}
        self._read_ns: int | None = None
        self._stop: WakeUp[None] = WakeUp()
        # bound before all other sockets: a connection without a handler is refused for ever
        self._socket: zmq.Socket[bytes] = context.socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.bind(_ZAP_ADDRESS)
        self._thread = threading.Thread(target=self._serve, name="authenticator", daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._stop.fileno(), zmq.POLLIN)
        while self._stop.fileno() not in (ready := dict(poller.poll())):
            if self._socket in ready:
                self._socket.send_multipart(self.answer(self._socket.recv_multipart()))
        self._socket.close()

    def answer(self, request: Sequence[bytes]) -> list[bytes]:
        """Return the reply to a request of the protocol: 200 and the owner's name, or 400 and no name."""
        version, request_id, domain, _address, _identity, mechanism, *credentials = [*request, *[b""] * 7][:7]
        known = version == b"1.0" and domain == DOMAIN and mechanism == b"CURVE" and len(request) == 7
        name = self._name_of(credentials[0]) if known else None
        if name is None:
            return [b"1.0", request_id, b"400", b"this key is not among the public keys", b"", b""]
        return [b"1.0", request_id, b"200", b"OK", name, b""]

    def _name_of(self, key: bytes) -> bytes | None:
        if key not in self._names:
            self._read_again()
        return self._names.get(key)

    def _read_again(self) -> None:
        # no new file gives a known key another name
        folder = self._keys.folder
        if folder is None:
            return
        try:
            changed_ns = folder.stat().st_mtime_ns
            if changed_ns == self._read_ns:
                return
            found = {z85.decode(key): name.encode() for key, name in public_keys(folder, self._keys.name).items()}
        except (OSError, ConfigError, ValueError):
            return  # a file may be half written: the next unknown key reads the folder again
        self._names, self._read_ns = {**found, **self._names}, changed_ns

    def close(self) -> None:
        """Stop the thread. Close the context only afterwards."""
        self._stop.post()
        self._thread.join()
        self._stop.close()
