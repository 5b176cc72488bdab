"""CURVE keys: one pair a component, in a folder of certificates.

    keys/public/<name>.key            to be copied to every computer that takes part
    keys/private/<name>.key_secret    only where the component runs

The files are those of ZeroMQ's own tools (ZPL), so that peers of other makes can use them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import zmq

from afspm.errors import ConfigError
from afspm.model import component_of

_NAME = re.compile(r"[A-Za-z0-9_. +-]{1,100}")
_ENTRY = re.compile(r'^\s*(public-key|secret-key)\s*=\s*"([^"]{40})"\s*$', re.MULTILINE)


@dataclass(frozen=True)
class Keys:
    """What a process needs to prove who it is and to know the others.

    Attributes:
        name: whose keys these are.
        public, secret: the own pair, as Z85 text.
        peers: the public keys that are let in, and the names of their owners.
        servers: the names of those who bind the addresses that we connect to, by address.
        folder: where they came from; keys that are put there later are found; None: these are all.
    """

    name: str
    public: bytes
    secret: bytes = field(repr=False)
    peers: Mapping[bytes, str]
    servers: Mapping[str, str] = field(default_factory=dict)
    folder: Path | None = None

    def server_key(self, address: str) -> bytes:
        """The public key that whoever binds `address` must have."""
        name = self.servers.get(address)
        if name is None:
            raise ConfigError(
                "it is not known whose key to expect at this address", where=address,
                hint="name its owner in the keys of this process",
            )  # fmt: skip
        for key, owner in self.peers.items():
            if owner == name:
                return key
        raise ConfigError(
            f"there is no public key of {name!r}", where=address, hint=f"afspm keys can make one: {name}.key"
        )


def load(folder: str | Path, name: str, servers: Mapping[str, str] | None = None) -> Keys:
    """The keys of the component `name` out of the folder that `generate` made.

    Raises:
        ConfigError: no such folder or key, or a file that is no certificate.
    """
    folder = Path(folder)
    secret_file = folder / "private" / f"{_checked(name)}.key_secret"
    if not secret_file.exists() and (folder / "public" / f"{name}.key").exists():
        raise ConfigError(
            f"the secret key of {name!r} is not here, only the public one",
            where=str(secret_file),
            hint=f"copy it from where it was made; if it is lost, delete public/{name}.key everywhere and make another",
        )
    entries = _read(secret_file, name)
    if "secret-key" not in entries:
        raise ConfigError("there is no secret key in this file", where=str(secret_file))
    peers = public_keys(folder, name)
    return Keys(name, entries["public-key"], entries["secret-key"], peers, dict(servers or {}), folder)


def public_keys(folder: Path, name: str) -> dict[bytes, str]:
    """The public keys in a folder, with the names of their owners; read for `name`. Raises ConfigError, as `load`."""
    files = sorted((folder / "public").glob("*.key"))
    return {_read(file, name)["public-key"]: file.name.removesuffix(".key") for file in files}


def from_launch(name: str, entries: Mapping[str, str] | None) -> Keys | None:
    """The keys that a launch line speaks of: `{"folder": …, "<address>": "<name of who binds it>", …}`.

    Whoever acts for a person ("dashboard:Ada") does so with the key of the component.
    """
    if not entries or "folder" not in entries:
        return None
    servers = {address: owner for address, owner in entries.items() if "://" in address}
    return load(entries["folder"], component_of(name), servers)


def generate(folder: str | Path, names: Iterable[str]) -> list[Path]:
    """Make a key pair for each of `names` that has none yet; returns the files written.

    Existing keys are left alone: a new component joins without the others being told anew. A public key alone is that
    of a process on another computer; where it got lost, it is in the file of the secret one.

    Raises:
        ConfigError: a name that no file can have, or a file that is no certificate.
    """
    folder = Path(folder)
    written = []
    for directory in (folder / "public", folder / "private"):
        directory.mkdir(parents=True, exist_ok=True)
    for name in names:
        public_file = folder / "public" / f"{_checked(name)}.key"
        secret_file = folder / "private" / f"{name}.key_secret"
        if public_file.exists():
            continue
        if secret_file.exists():
            public = _read(secret_file, name)["public-key"]
        else:
            public, secret = zmq.curve_keypair()
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
    text = "\n".join(["#   ZeroMQ CURVE certificate of afspm. Keep a secret key to yourself.", "metadata", "curve",
                      *lines, ""])  # fmt: skip
    # created with its mode: a secret is never readable by others, not even for a moment
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
        raise ConfigError("this is not a certificate: it has no public key", where=str(file))
    return entries
