"""Recognition of the runs that this user has made: the folders from which their classes may be imported again.

`run.json` names these folders, but anybody can write one: a run folder may come from another person. So the supervisor
signs them with a key in the user's state folder, together with the path and the file number of the run folder. A copy,
a moved folder, or a folder unpacked in the place of a run has no valid signature, and neither has another list.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import json
import logging
import os
import secrets
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from afspm.basics.plain_data import Plain
from afspm.record.run_json import run_json_or_empty

HOMES: Final = "homes"
"""Key in run.json: the folders of the original experiment files, in which classes are found."""
SIGNATURE: Final = "signature"
"""Key in run.json: the signature of `homes`."""
KEY_FILE: Final = "runs.key"
_KEY_BYTES: Final = 32
_log = logging.getLogger("afspm.own_runs")


def signed(folder: Path, homes: Sequence[str]) -> Plain:
    """Return the entries of run.json for the folders of classes; without a signature if no key can be kept."""
    try:
        key = _key()
    except OSError as error:
        _log.warning("this run will not be known as yours, as its key can't be kept: %s", error)
        return {HOMES: [*homes]}
    return {HOMES: [*homes], SIGNATURE: _signature(key, folder, homes)}


def own_homes(folder: Path) -> list[Path] | None:
    """Return the folders of the classes of a run, as this user's run wrote them; None for any other folder."""
    facts = run_json_or_empty(folder)
    homes, signature = facts.get(HOMES), facts.get(SIGNATURE)
    if not (isinstance(homes, list) and isinstance(signature, str) and all(isinstance(one, str) for one in homes)):
        return None
    try:
        expected = _signature(_existing_key(), folder, homes)
    except OSError:
        return None
    return [*map(Path, homes)] if hmac.compare_digest(expected.encode(), signature.encode()) else None


def register_own_messages(folder: Path, messages: Sequence[str]) -> None:
    """Register the messages that run.json names, if this user has made the run; else as its record describes them.

    Importing them would run modules of another person's choice. A warning is logged if the record has no description.

    Raises:
        ConfigError: as for `register_all`.
    """
    if not messages:
        return
    if (homes := own_homes(folder)) is None:
        from afspm.night.run import declare_described

        if declare_described(folder):
            return
        _log.warning("messages of %s are not read: %s is not known as a run of yours", ", ".join(messages), folder)
        return
    # imported late: few experiments have messages of their own
    from afspm.experiment.class_loader import importing_from
    from afspm.wire.message_types import register_all

    with importing_from(homes):  # the modules may lie beside the experiment file, as for the run itself
        register_all(messages)


def state_folder() -> Path:
    """Return the folder in which afspm keeps the state of this user."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "afspm"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Application Support" / "afspm"
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "afspm"


def _signature(key: bytes, folder: Path, homes: Sequence[str]) -> str:
    place = folder.resolve()
    # the file number: an unpacked folder may take the place of a run under the same path
    text = json.dumps([str(place), place.stat().st_ino, [*homes]])
    return hmac.new(key, text.encode(), hashlib.sha256).hexdigest()


def _key() -> bytes:
    with contextlib.suppress(FileNotFoundError):
        return _existing_key()
    folder = state_folder()
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    new = folder / f"{KEY_FILE}.{secrets.token_hex(8)}"
    with open(new, "xb", opener=lambda path, flags: os.open(path, flags, 0o600)) as file:
        file.write(secrets.token_bytes(_KEY_BYTES))
    try:
        os.link(new, folder / KEY_FILE)  # two first runs may start at once: the first key stays
    except FileExistsError:
        pass
    finally:
        new.unlink()
    return _existing_key()


def _existing_key() -> bytes:
    key = (state_folder() / KEY_FILE).read_bytes()
    if len(key) != _KEY_BYTES:
        raise OSError(f"{state_folder() / KEY_FILE} is damaged: delete it")
    return key
