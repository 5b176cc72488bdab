"""The user's message types, from Python modules (made by protoc, or with declarations) or from .proto files."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

from afspm import wire
from afspm.basics import named_imports
from afspm.basics.errors import ConfigError


def register_all(sources: Iterable[str]) -> None:
    """Register the messages in modules ("my_lab.messages_pb2") and files ("peaks.proto") by their names.

    A module may hold `MessageDeclaration`s, which give more than the types of its messages.

    Raises:
        ConfigError: a module or file does not exist, has errors, or holds no messages; or a .proto file has no compiler
            (the extra `messages`).
        InvalidValue: another message has the name of one of these.
    """
    for source in sources:
        module = _compiled(Path(source)) if source.endswith(".proto") else _imported(source)
        descriptor = getattr(module, "DESCRIPTOR", None)
        names = list(getattr(descriptor, "message_types_by_name", ()))
        declarations = [one for one in vars(module).values() if isinstance(one, wire.MessageDeclaration)]
        for declaration in declarations:
            wire.declare(declaration)
        if not (names or declarations):
            raise ConfigError(
                "holds no message types",
                where=source,
                hint="name a module that protoc has made, or that holds declarations",
            )
        for name in names:
            wire.register(getattr(module, name))


def _imported(name: str) -> ModuleType:
    try:
        return named_imports.import_named(name)
    except (Exception, SystemExit) as error:  # importing runs the user's code, which may raise anything, even exit
        raise ConfigError(
            f"can't be imported: {type(error).__name__}: {error}",
            where=name,
            hint="is it on the Python path, or beside the experiment file?",
        ) from error


def _compiled(path: Path) -> ModuleType:
    # the compiled module is not kept: the .proto file may change before the next start
    if not path.is_file():
        raise ConfigError("there is no such file", where=str(path))
    import tempfile  # imported late: few experiments have their own messages, and every process would start later

    try:
        from grpc_tools import protoc
    except ImportError:
        raise ConfigError(
            "this file needs a compiler for messages",
            where=str(path),
            hint='pip install "afspm[messages]", or name a _pb2 module',
        ) from None
    # for files that import google/protobuf/*.proto
    well_known = Path(protoc.__file__).parent / "_proto"
    with tempfile.TemporaryDirectory(prefix="afspm-") as folder:
        arguments = ["protoc", f"-I{path.parent}", f"-I{well_known}", f"--python_out={folder}", str(path)]
        if protoc.main(arguments) != 0:
            raise ConfigError("has errors; the compiler's messages are above", where=str(path))
        name = f"{path.stem.replace('-', '_')}_pb2"
        spec = importlib.util.spec_from_file_location(name, Path(folder) / f"{name}.py")
        if spec is None or spec.loader is None:
            raise ConfigError("protoc has not made a module from this file", where=str(path))
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
    return module
