"""The types of users' messages as data: a record has them, so that it is read without the user's package.

A description is read without running any code of the record's author, unlike a module with the types.
"""

from __future__ import annotations

from base64 import b64decode, b64encode
from typing import Any

from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from afspm.basics.plain_data import Plain
from afspm.wire.messages import declared, is_of_afspm


def describe() -> Plain:
    """Return the types of all messages that are not of afspm, in JSON's types; empty without any."""
    types = {one.name: one.type.DESCRIPTOR for one in declared() if not is_of_afspm(one.name)}
    files: dict[str, str] = {}
    for described in types.values():
        _add(described.file, files)
    names = {name: described.full_name for name, described in types.items()}
    return {"types": names, "files": [*files.values()]} if types else {}


def _add(file: Any, files: dict[str, str]) -> None:
    # a pool takes a file only after the files that it imports
    for imported in file.dependencies:
        _add(imported, files)
    files.setdefault(file.name, b64encode(file.serialized_pb).decode())


def read(description: Any) -> dict[str, type[Message]]:
    """Return the types in a description by the names of their messages; empty if it is damaged or missing.

    A type that this process has registered is left out: its own class is used instead.
    """
    pool = DescriptorPool()
    registered = {one.name: one.type.DESCRIPTOR.full_name for one in declared()}
    try:
        for content in description["files"]:
            pool.AddSerializedFile(b64decode(content))
        return {
            name: GetMessageClass(pool.FindMessageTypeByName(full_name))
            for name, full_name in description["types"].items()
            if not is_of_afspm(name) and registered.get(name) != full_name
        }
    except (AttributeError, DecodeError, KeyError, TypeError, ValueError):
        return {}
