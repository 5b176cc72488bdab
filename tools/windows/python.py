"""Sets up a Windows Python under Wine in build/windows: `python3 tools/windows/python.py`; with arguments, runs it.

Needs Debian's packages wine, wine64, maven and gcc-mingw-w64-x86-64-win32 (as root they are installed), 700 MB of disk
for the packages and as much for Wine itself. Everything is fetched once; the wheel is built each time.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import struct
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import IO

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))

from bootstrap import find_uv  # noqa: E402

FOLDER = ROOT / "build" / "windows"
PREFIX = FOLDER / "wine"
PYTHON = FOLDER / "python"
PACKAGES = PYTHON / "lib" / "site-packages"
REQUIREMENTS = Path(__file__).with_name("requirements.txt")
WINE = Path("/usr/lib/wine/wine64")
CPYTHON = "org.bytedeco:cpython:3.11.3-1.5.9:jar:windows-x86_64"
CPYTHON_SHA256 = "3263a50b256447bb7b9e604d6587627e419891370fc33b94469e6a06ff4de834"
GCC, OBJDUMP = (Path(f"/usr/bin/x86_64-w64-mingw32-{name}") for name in ("gcc", "objdump"))
MATH, OUR_MATH = "api-ms-win-crt-math-l1-1-0.dll", "mingws-and-crt-math-l1-1-0.dll"
assert len(MATH) == len(OUR_MATH)  # it is written over the other
_COMPLEX = re.compile(r"c(a?(sin|cos|tan)h?|exp|log|sqrt|pow|arg|abs)[fl]?")
_IMPORT = re.compile(r"^\t[0-9a-f]+\t\s*\d+\s+(\S+)", re.MULTILINE)
LAST_WORDS_S = 2.0
"""So long output is still read after the end: what the program has left behind holds it open."""
IN_JAR = "org/bytedeco/cpython/windows-x86_64/"
ENVIRONMENT = {
    "WINEPREFIX": str(PREFIX),
    "WINEDEBUG": "-all",
    "WINEDLLOVERRIDES": "mscoree,mshtml=",
    "XDG_RUNTIME_DIR": "/tmp",
    "PYTHONDONTWRITEBYTECODE": "",
}


def main() -> None:
    """Without arguments, set up what is missing and install the package; with arguments, run Python with them."""
    if not sys.argv[1:]:
        _install_programs()
        _unpack_python()
        _build_launcher()
        _install_packages()
        _make_prefix()
        _install_afspm()
        return
    # Wine's server and services are started apart, else they would hold our output open
    environment = {**os.environ, **ENVIRONMENT}
    for apart in ([str(WINE.with_name("wineserver")), "-p60"], [str(WINE), "wineboot"]):
        subprocess.run(apart, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
    # a pipe as standard output, since Wine's console is not that of Windows; a terminal as standard input gives it one
    terminal, ours = os.openpty()
    threading.Thread(target=_forget, args=(terminal,), daemon=True).start()
    run = subprocess.Popen(
        [str(WINE), str(PYTHON / "python.exe"), *sys.argv[1:]],
        env=environment,
        stdin=ours,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert run.stdout is not None
    passing_on = threading.Thread(target=_pass_on, args=(run.stdout,), daemon=True)
    passing_on.start()
    code = run.wait()
    passing_on.join(LAST_WORDS_S)
    sys.exit(code)


def _forget(terminal: int) -> None:
    """Read what Wine writes to its console, which says nothing of ours."""
    while os.read(terminal, 4096):
        pass


def _pass_on(output: IO[bytes]) -> None:
    for line in output:
        sys.stdout.buffer.write(line.replace(b"\r\n", b"\n"))
        sys.stdout.flush()


def _install_programs() -> None:
    programs = {"wine64": WINE.exists(), "maven": shutil.which("mvn"), "gcc-mingw-w64-x86-64-win32": GCC.exists()}
    missing = [package for package, found in programs.items() if not found]
    if not missing:
        return
    packages = ["wine", *missing] if "wine64" in missing else missing
    install = ["apt-get", "install", "-y", "-qq", "--no-install-recommends", *packages]
    if not shutil.which("apt-get") or os.geteuid() != 0:
        sys.exit(f"missing here; as root on Debian: {' '.join(install)}")
    subprocess.run(["apt-get", "update", "-qq"], check=False)
    subprocess.run(install, check=True, stdout=subprocess.DEVNULL)


def _unpack_python() -> None:
    if (PYTHON / "python.exe").exists():
        return
    jars = FOLDER / "maven"
    subprocess.run(
        [
            "mvn",
            "-q",
            "-B",
            "dependency:get",
            f"-Dartifact={CPYTHON}",
            "-Dtransitive=false",
            f"-Dmaven.repo.local={jars}",
        ],
        check=True,
    )
    [jar] = jars.rglob("cpython-*-windows-x86_64.jar")
    if (found := hashlib.sha256(jar.read_bytes()).hexdigest()) != CPYTHON_SHA256:
        sys.exit(f"{jar} is not the file that is expected: its sha256 is {found}")
    with zipfile.ZipFile(jar) as archive:
        for name in archive.namelist():
            if name.startswith(IN_JAR) and not name.endswith("/"):
                # the standard library lies in "lib"; a second folder "Lib" would hide it
                parts = ["lib" if part == "Lib" else part for part in name.removeprefix(IN_JAR).split("/")]
                target = PYTHON.joinpath(*parts)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(archive.read(name))
    # extensions for any Python 3 (psutil's) look for its stable functions there
    stable = _symbols((PYTHON / "libs" / "python3.lib").read_bytes())
    _build_library(PYTHON / "python3.dll", [f"{name} = python311.{name}" for name in stable])


def _build_launcher() -> None:
    """Build what a virtual environment has as its python.exe."""
    launcher = PYTHON / "venvlauncher.exe"
    if not launcher.exists():
        source = Path(__file__).with_name("venvlauncher.c")
        subprocess.run([str(GCC), "-O2", "-s", "-static", "-municode", "-o", str(launcher), str(source)], check=True)


def _symbols(library: bytes) -> list[str]:
    """Return the functions and variables of an import library (an archive; its first member lists its symbols)."""
    (count,) = struct.unpack_from(">I", library, 8 + 60)
    names = library[8 + 60 + 4 + 4 * count :].split(b"\0", count)[:count]
    return [name.decode().removeprefix("__imp_") for name in names if name.startswith(b"__imp_")]


def _install_packages() -> None:
    installed = FOLDER / "requirements.txt"
    if installed.exists() and installed.read_bytes() == REQUIREMENTS.read_bytes():
        return
    _pip("--requirement", str(REQUIREMENTS))
    _pip("--no-deps", "nanonis-spm")
    _add_complex_functions()
    shutil.copyfile(REQUIREMENTS, installed)


def _add_complex_functions() -> None:
    """Build the functions of complex numbers that Wine lacks, and lead the packages that call them there."""
    names: set[str] = set()
    for package in [*PACKAGES.rglob("*.pyd"), *PACKAGES.rglob("*.dll")]:
        imported = _imported(package, MATH) | _imported(package, OUR_MATH)  # led there by an earlier set-up
        if any(map(_COMPLEX.fullmatch, imported)):
            names |= imported
            package.write_bytes(package.read_bytes().replace(MATH.encode(), OUR_MATH.encode()))
    ours = {name: f"wine_{name.removesuffix('l')}" for name in names if _COMPLEX.fullmatch(name)}
    exports = [f"{name} = {ours.get(name, f'ucrtbase.{name}')}" for name in names]
    _build_library(PYTHON / OUR_MATH, exports, str(Path(__file__).with_name("complex.c")))


def _imported(program: Path, library: str) -> set[str]:
    """Return the names of the functions that a program for Windows takes from a library."""
    listed = subprocess.run([str(OBJDUMP), "-p", str(program)], capture_output=True, text=True, check=True).stdout
    blocks = listed.split("DLL Name: ")[1:]
    return {name for block in blocks if block.startswith(library) for name in _IMPORT.findall(block)}


def _install_afspm() -> None:
    _pip("--no-deps", "--reinstall", str(ROOT))


def _pip(*arguments: str) -> None:
    # copies, since some files are changed: a link would change those in the cache
    for_windows = ["--python-platform", "x86_64-pc-windows-msvc", "--python-version", "3.11", "--target", str(PACKAGES)]
    subprocess.run(
        [find_uv(), "pip", "install", "--quiet", "--link-mode", "copy", *for_windows, *arguments], check=True
    )


def _make_prefix() -> None:
    system = PREFIX / "drive_c" / "windows" / "system32"
    if not (PREFIX / "system.reg").exists():
        PREFIX.mkdir(parents=True, exist_ok=True)
        subprocess.run([str(WINE), "wineboot", "-i"], env={**os.environ, **ENVIRONMENT}, check=True)
    library = system / "bcryptprimitives.dll"
    if not library.exists():  # pydantic's core asks it for random numbers
        _build_library(library, ["ProcessPrng = advapi32.SystemFunction036"])


def _build_library(path: Path, exports: Iterable[str], *sources: str) -> None:
    """Build a DLL from C, or one that only forwards: an export is `name = function` or `name = library.function`."""
    definitions = path.with_suffix(".def")
    definitions.write_text("\n".join(["EXPORTS", *sorted(exports)]), encoding="utf-8")
    start = [] if sources else ["-nostdlib", "-Wl,--entry,0"]
    subprocess.run(
        [str(GCC), "-O2", "-shared", "-static-libgcc", "-o", str(path), *start, *sources, str(definitions)], check=True
    )


if __name__ == "__main__":
    main()
