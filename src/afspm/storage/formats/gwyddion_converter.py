"""Files in formats that only Gwyddion reads, converted to .gwy by its program `gwyconvert`.

The program has another licence than afspm (GPL-2.0-or-later) and reads files of strangers in C: it is installed by the
user, and runs as a process of its own with limits of time and, except on Windows, of memory.

Sizes and values of a Nanonis scan come through it exactly. Its place does not: the sign of y is wrong, and the angle is
lost. What holds for other makers is unknown, so regions have the size alone, about (0, 0).
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
from dataclasses import replace
from datetime import tzinfo
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from afspm.basics.errors import FileError
from afspm.storage.formats import suffixes
from afspm.storage.formats.content import FileContent, OtherFormat
from afspm.storage.formats.converted_files import checked
from afspm.storage.formats.gwyddion_reader import read_gwyddion

PROGRAM: Final = "gwyconvert"
_PACKAGE: Final = "gwyddionpy_converter"
LONGEST_S = 60.0
MEMORY_KB = 4 << 20
_LIMITED: Final = ("sh", "-c", 'ulimit -v "$0" && exec "$@"')
"""A shell that limits the memory of a program: the limit, the program and its arguments follow."""


def read_other(path: Path, zone: tzinfo | None) -> FileContent:
    """Return the images and curves of a file that Gwyddion's converter can read; `header` says which module read it.

    Raises:
        OtherFormat: the converter is not installed, or can't read the file.
        FileError: the converter took too long, or the file is cut off.
    """
    program = _program()
    if program is None:
        raise OtherFormat(
            f"afspm has no reader for {path.suffix or 'a file without a suffix'}",
            hint=f'read: {" ".join(suffixes())}; Gwyddion\'s converter reads others: pip install "afspm[formats]"',
        )
    with TemporaryDirectory() as folder:
        made = Path(folder) / "converted.gwy"
        limits = (*_LIMITED, str(MEMORY_KB)) if os.name == "posix" else ()
        command = [*limits, program, str(path.absolute()), str(made)]
        # numbers with decimal points, and no warnings about missing parts of a desktop
        environment = os.environ | {"LC_ALL": "C", "GTK_MODULES": ""}
        try:
            done = subprocess.run(
                command, capture_output=True, timeout=LONGEST_S, env=environment, cwd=folder, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise FileError(f"is not read: {PROGRAM} did not end within {LONGEST_S:g} s") from error
        if done.returncode != 0 or not made.is_file():
            said = done.stderr.decode("utf-8", "replace").strip().splitlines()
            raise OtherFormat(f"can't be read by Gwyddion's converter either: {said[-1] if said else 'no reason'}")
        content = read_gwyddion(made, zone, is_converted=True)
    module = _module(done.stdout)
    scans = tuple(replace(one, region=one.region.moved_to((0.0, 0.0)), filename=str(path)) for one in content.scans)
    spectra = tuple(replace(spectrum, filename=str(path)) for spectrum in content.spectra)
    found = checked(replace(content, controller="", scans=scans, spectra=spectra), module, path, zone)
    place = "unknown: the converter keeps neither the angle nor y's sign"
    return replace(found, header={**found.header, "read by": f"Gwyddion, module {module}", "place": place})


def _program() -> str | None:
    found = shutil.which(PROGRAM)
    package = importlib.util.find_spec(_PACKAGE)
    if found is None and package is not None and package.origin is not None:
        folder = Path(package.origin).parent / "bin"
        found = next((str(file) for name in (PROGRAM, f"{PROGRAM}.exe") if (file := folder / name).is_file()), None)
    return found


def _module(output: bytes) -> str:
    try:
        said = json.loads(output)
    except ValueError:
        return "unknown"
    return str(said.get("module", "unknown")) if isinstance(said, dict) else "unknown"
