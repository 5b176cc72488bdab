"""The files that a sealed agent may read: its program, its Python modules, and those named by `--read`."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from importlib.machinery import all_suffixes
from pathlib import Path
from typing import Final

from afspm.basics import ConfigError, FileError, python_command, python_environment

LINES_FILE: Final = "trials.jsonl"
"""The file with a line for each trial: the mark of the output folder of any bench."""
_VENV: Final = "pyvenv.cfg"


class AgentFiles:
    """The files that an agent may read while it is sealed.

    Args:
        command: program and arguments of the agent; empty for a class.
        import_from: folders with the agent's Python modules. They may hold the output of a bench, so not the folders
            themselves are readable, but the modules and packages in them.
        read: files and folders named by the user.

    Attributes:
        readable: all readable files and folders, absolute.
    """

    def __init__(self, command: Sequence[str], import_from: Sequence[str], read: Sequence[Path]) -> None:
        self._read = [path.resolve() for path in read]
        for given, path in zip(read, self._read, strict=True):
            if not path.exists():
                raise FileError("there is no such file or folder", where=str(given), hint="see --read")
        self._modules = {path.name: path for folder in reversed(import_from) for path in self._in(Path(folder))}
        own = [path.resolve() for path in self._modules.values()]
        self._searched = [*self._read, *own, *_python_path()]
        self.readable = list(dict.fromkeys([*own, *self._read, *_program(command), *_interpreter()]))

    def require_no_output(self, *outputs: Path) -> None:
        """Refuse a readable folder with the output of a bench inside: the agent could read the truth.

        Args:
            outputs: folders of this bench.

        Raises:
            ConfigError: a readable folder holds one of `outputs` or the output of another bench, or lies in one.
        """
        for folder in self.readable:
            for output in outputs:
                if output.is_relative_to(folder):
                    raise _leaks(output, folder)
        for path in self._read:
            for folder in path.parents:
                if (folder / LINES_FILE).is_file():
                    raise _leaks(folder, path)
        for folder in self._searched:
            for inside, _, files in os.walk(folder):
                if LINES_FILE in files:
                    raise _leaks(Path(inside), folder)

    def link_modules(self, into: Path) -> None:
        """Make a folder with links to the agent's modules, from which Python can import them.

        Python lists a folder before it imports from it, and the modules' own folder can't be listed by a sealed
        process.
        """
        into.mkdir(mode=0o700)
        for name, path in self._modules.items():
            (into / name).symlink_to(path)

    def _in(self, folder: Path) -> Iterator[Path]:
        for path in folder.iterdir():
            is_module = path.is_file() and path.name.endswith(tuple(all_suffixes()))
            if is_module or (path / "__init__.py").is_file() or path.resolve() in self._read:
                yield path.absolute()


def _leaks(output: Path, readable: Path) -> ConfigError:
    return ConfigError(
        f"the agent could read the output of a bench, {output}, since it may read {readable}",
        hint="choose another --output, or move it; --read and PYTHONPATH name such folders",
    )


def _interpreter() -> list[Path]:
    # of a new process, as the agent's is: this process's own path may have the current folder
    command = python_command("afspm_bench.sealing")
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, env={**os.environ, **python_environment()}
    )
    return [Path(path).resolve() for path in json.loads(done.stdout)]


def _python_path() -> list[Path]:
    return [Path(path).resolve() for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]


def _program(command: Sequence[str]) -> Iterator[Path]:
    for word in command:
        if Path(word).is_file():
            yield Path(word).resolve()
    if not command or (found := shutil.which(command[0])) is None:
        return
    program, target = Path(found).absolute(), Path(found).resolve()
    yield target
    home = program.parent.parent
    if (home / _VENV).is_file():  # a Python in a virtual environment needs this, and the Python that made it
        yield home.resolve()
    if any(target.parent.parent.glob("lib/python3*")):
        yield target.parent.parent
