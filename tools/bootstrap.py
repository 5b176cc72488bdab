"""Makes the environment .venv from the lock file, with nothing but Python 3.11 or later.

Run by the Makefile: `python3 tools/bootstrap.py`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
TOOLS = ROOT / "build" / "tools"
UV_VERSION = "uv>=0.5,<1"


def main() -> None:
    if sys.version_info < (3, 11):  # noqa: UP036  (it is run by whatever python3 there is)
        sys.exit(f"afspm needs Python 3.11 or later, this is {sys.version.split()[0]}")
    uv = find_uv()
    environment = {**os.environ, "UV_PROJECT_ENVIRONMENT": str(VENV), "UV_PYTHON_DOWNLOADS": "never"}
    environment.pop("VIRTUAL_ENV", None)
    command = [uv, "sync", "--frozen", "--all-extras", "--python", sys.executable, "--quiet"]
    if subprocess.run(command, cwd=ROOT, env=environment).returncode != 0:
        sys.exit("the environment could not be made: see above")
    _compile()


def _compile() -> None:
    """Compile all modules now, as pip would and uv does not: an experiment starts many processes, and where Python may
    not keep what it compiled (PYTHONDONTWRITEBYTECODE), each would spend most of its start on compiling them again."""
    python = VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    packages = "import sysconfig; print(sysconfig.get_path('purelib'))"
    folder = subprocess.run([str(python), "-c", packages], capture_output=True, text=True, check=True).stdout.strip()
    # what can't be compiled is a package's template for another Python: nobody imports it
    subprocess.run([str(python), "-m", "compileall", "-qq", "-j", "0", folder, str(ROOT / "src")], check=False)


def find_uv() -> str:
    """Return the uv of this computer, or one in an environment of its own, made with the standard library's venv."""
    if found := shutil.which("uv"):
        return found
    folder = TOOLS / ("Scripts" if os.name == "nt" else "bin")
    uv = folder / ("uv.exe" if os.name == "nt" else "uv")
    if not uv.exists():
        _make_venv()
        subprocess.run([str(folder / "python"), "-m", "pip", "install", "--quiet", UV_VERSION], check=True)
    return str(uv)


def _make_venv() -> None:
    if subprocess.run([sys.executable, "-m", "venv", "--clear", str(TOOLS)], capture_output=True).returncode == 0:
        return
    # Debian keeps what venv needs in a package of its own
    package = f"python{sys.version_info.major}.{sys.version_info.minor}-venv"
    if shutil.which("apt-get") and hasattr(os, "geteuid") and os.geteuid() == 0:
        subprocess.run(["apt-get", "update", "-qq"], check=False)
        subprocess.run(["apt-get", "install", "-y", "-qq", package], check=True)
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(TOOLS)], check=True)
        return
    sys.exit(f"Python's venv module is incomplete here; on Debian: apt install {package}")


if __name__ == "__main__":
    main()
