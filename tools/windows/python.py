"""Sets up a Windows Python under Wine in build/windows, and runs it: `python3 tools/windows/python.py -m pytest …`.

Needs Debian's packages wine, wine64 and maven (as root they are installed), 700 MB of disk for the packages and as much
for Wine itself. Everything is fetched once; the package's wheel is built anew at every run.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

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
IN_JAR = "org/bytedeco/cpython/windows-x86_64/"
ENVIRONMENT = {
    "WINEPREFIX": str(PREFIX),
    "WINEDEBUG": "-all",
    "WINEDLLOVERRIDES": "mscoree,mshtml=",
    "XDG_RUNTIME_DIR": "/tmp",
    "PYTHONDONTWRITEBYTECODE": "",
}


def main() -> None:
    """Set up whatever is missing, install the package, and run Python with our arguments."""
    _install_programs()
    _unpack_python()
    _install_packages()
    _make_prefix()
    _install_afspm()
    # Wine's server is started apart, else it would say things of its own on our output
    environment = {**os.environ, **ENVIRONMENT}
    subprocess.run([str(WINE.with_name("wineserver")), "-p60"], env=environment, stderr=subprocess.DEVNULL, check=False)
    # a pipe as standard output, and no terminal as standard input: Wine's console is not that of Windows
    run = subprocess.Popen(
        [str(WINE), str(PYTHON / "python.exe"), *sys.argv[1:]],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert run.stdout is not None
    for line in run.stdout:
        sys.stdout.buffer.write(line.replace(b"\r\n", b"\n"))
        sys.stdout.flush()
    sys.exit(run.wait())


def _install_programs() -> None:
    missing = [package for package, found in (("wine64", WINE.exists()), ("maven", shutil.which("mvn"))) if not found]
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
    forwarded = forwarding_library("python3.dll", {name: f"python311.{name}" for name in stable})
    (PYTHON / "python3.dll").write_bytes(forwarded)


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
    shutil.copyfile(REQUIREMENTS, installed)


def _install_afspm() -> None:
    _pip("--no-deps", "--reinstall", str(ROOT))


def _pip(*arguments: str) -> None:
    for_windows = ["--python-platform", "x86_64-pc-windows-msvc", "--python-version", "3.11", "--target", str(PACKAGES)]
    subprocess.run([find_uv(), "pip", "install", "--quiet", *for_windows, *arguments], check=True)


def _make_prefix() -> None:
    system = PREFIX / "drive_c" / "windows" / "system32"
    if not (PREFIX / "system.reg").exists():
        PREFIX.mkdir(parents=True, exist_ok=True)
        subprocess.run([str(WINE), "wineboot", "-i"], env={**os.environ, **ENVIRONMENT}, check=True)
    library = system / "bcryptprimitives.dll"
    if not library.exists():  # pydantic's core asks it for random numbers
        library.write_bytes(forwarding_library(library.name, {"ProcessPrng": "advapi32.SystemFunction036"}))


def forwarding_library(name: str, exports: dict[str, str]) -> bytes:
    """Return a DLL that only forwards: each of its functions to `library.function` (PE/COFF, forwarder exports)."""
    base, table = 0x1000, 40
    names = sorted(exports)
    count = len(names)
    functions, pointers, ordinals = table, table + 4 * count, table + 8 * count
    section = bytearray(table + 10 * count)

    def text(string: str) -> int:
        place = len(section)
        section.extend(string.encode() + b"\0")
        return base + place

    title = text(name)
    for index, export in enumerate(names):
        struct.pack_into("<I", section, pointers + 4 * index, text(export))
        struct.pack_into("<H", section, ordinals + 2 * index, index)
        struct.pack_into("<I", section, functions + 4 * index, text(exports[export]))
    directory = (0, 0, 0, 0, title, 1, count, count, base + functions, base + pointers, base + ordinals)
    struct.pack_into("<IIHHIIIIIII", section, 0, *directory)
    size = len(section)
    padded = -(-size // 512) * 512
    image = base + -(-size // 0x1000) * 0x1000
    dos = b"MZ" + bytes(58) + struct.pack("<I", 64)
    coff = struct.pack("<HHIIIHH", 0x8664, 1, 0, 0, 0, 240, 0x2022)
    optional = struct.pack("<HBBIIIII", 0x20B, 14, 0, 0, padded, 0, 0, base)
    optional += struct.pack("<QIIHHHHHHIIIIHHQQQQII", 0x180000000, 0x1000, 0x200, 6, 0, 0, 0, 6, 0, 0, image, 0x200, 0,
                            2, 0x100, 0x100000, 0x1000, 0x100000, 0x1000, 0, 16)  # fmt: skip
    optional += struct.pack("<II", base, size) + bytes(8 * 15)
    header = struct.pack("<8sIIIIIIHHI", b".edata", size, base, padded, 0x200, 0, 0, 0, 0, 0x40000040)
    head = dos + b"PE\0\0" + coff + optional + header
    return head.ljust(512, b"\0") + bytes(section).ljust(padded, b"\0")


if __name__ == "__main__":
    main()
