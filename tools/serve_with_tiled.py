"""Serves the folder of a run with `tiled serve directory`, and reads a scan and a spectrum of it with Tiled's client.

Run by `make test-tiled`, after `make test-nexus` has left runs in build/nexus-runs. Tiled has its own environment.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
from pathlib import Path

import bootstrap

ROOT = Path(__file__).resolve().parents[1]
RUNS = ROOT / "build" / "nexus-runs"
PACKAGE = "tiled[server,client]==0.2.20"
INDEXED = "Indexing complete"
READ = """
import sys
from tiled.client import from_uri
kind, field = sys.argv[2:]
files = from_uri(sys.argv[1])[kind]
arrays = [files[name]["entry"]["data"][field].read() for name in files]
print(len(arrays), arrays[0].shape, float(arrays[0].std()) > 0)
"""


def main() -> None:
    programs = bootstrap.environment_of("tiled", PACKAGE)
    for run, kind, field, expected in (
        ("scans", "scans", "height", "2 (128, 128) True"),
        ("bias", "spectra", "current", "2 (256,) True"),
    ):
        folder = max(RUNS.glob(f"{run}-*"), key=lambda one: one.stat().st_mtime, default=None)
        if folder is None:
            sys.exit("there is no run to serve: make test-nexus leaves some")
        told = _read(programs, folder, kind, field)
        sys.stdout.write(f"{folder.name}, {kind}/{field}: {told}\n")
        if told != expected:
            sys.exit(f"instead of {expected}")


def _read(programs: Path, folder: Path, kind: str, field: str) -> str:
    """Return what Tiled's client finds in the folder of a run that Tiled's server serves at a free port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [programs / "tiled", "serve", "directory", folder, "--public", "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as server:
        try:
            assert server.stdout is not None
            said = []
            for line in server.stdout:
                said.append(line)
                if INDEXED in line:
                    break
            else:
                return "".join(said)
            threading.Thread(target=server.stdout.read, daemon=True).start()
            client = [programs / "python", "-c", READ, f"http://127.0.0.1:{port}/api", kind, field]
            done = subprocess.run(client, capture_output=True, text=True, check=False)
            return done.stdout.strip() or done.stderr
        finally:
            server.kill()


main()
