"""The page on scripts and notebooks: its script joins its experiment while that runs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from afspm_process import AFSPM
from deadlines import DEADLINE_S
from tests.docs.test_snippets import FILE_NAME, ROOT, snippets

import afspm
from afspm.model import ScopeState

PAGE = ROOT / "docs" / "how-to" / "use-a-notebook.md"


def test_the_script_of_the_page_measures_and_ends_the_experiment(tmp_path: Path) -> None:
    for snippet in snippets(PAGE):
        if name := FILE_NAME.match(snippet.text):
            (tmp_path / name[1]).write_text(snippet.text, encoding="utf-8")
    command = (*AFSPM, "run", "--verbose", "--no-report", "experiment.toml")
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8"
    ) as run:
        try:
            assert run.stdout is not None
            assert any(" scheduler " in line and "is up" in line for line in run.stdout), "it never started"
            with afspm.connect(tmp_path / "runs", "waiter") as scope:  # the script says what state it is in by then
                assert scope.wait_until(lambda: scope.state is ScopeState.FREE, timeout_s=DEADLINE_S)
            script = subprocess.run(
                [sys.executable, "look.py"],
                cwd=tmp_path,
                capture_output=True,
                encoding="utf-8",
                timeout=DEADLINE_S,
                check=False,
            )
            assert script.returncode == 0, script.stderr
            assert "FREE 10000.0 nm/s" in script.stdout
            assert "Bias" in script.stdout or "bias" in script.stdout
            rest = run.stdout.read()
            assert run.wait(DEADLINE_S) == 0, rest
            assert "notebook ended the experiment" in rest
        finally:
            run.kill()
