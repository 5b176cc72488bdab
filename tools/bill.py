"""The bill: lines of code by capability, and how much each has grown since the last landing.

    python tools/bill.py [--base REV]

Lines of code are those without blanks, comments and docstrings. The first rule that matches a path decides: of a test,
its folder or a word in its name. The last landing is the commit named in `tools/last_landing.txt`, which the first
change after a landing renews.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import sys
import tarfile
from collections import defaultdict
from pathlib import Path
from typing import Final, NamedTuple

ROOT = Path(__file__).parents[1]
_LANDED = Path(__file__).with_name("last_landing.txt")
_COUNTED = ("src", "packages", "tests", "clients", "docs")
_PROGRAMS = {".py", ".rs", ".go", ".java", ".js", ".ts", ".c", ".h", ".cpp", ".m", ".cs", ".jl"}

RULES: Final[tuple[tuple[str, str, str], ...]] = (
    (
        "agents",
        r"packages/afspm-agents/src|safety/grants|requests/approvals|model/grants|report/agents",
        r"packages/afspm-agents|agent|grants|approval",
    ),
    ("agents: bench", r"packages/afspm-bench/src", r"tests/plugins/bench|system/bench/"),
    (
        "what-if, step and port logs",
        r"afspm-lab/src/afspm_lab/what_if|scheduler/step_log|client/port_log|storage/line_log",
        r"afspm-lab/tests|step_log|port_log|line_log|what_if",
    ),
    ("drift study on a cluster", r"afspm_lab", r"study"),
    ("bridge to the published afspm", r"afspm-published/src|published_form", r"afspm-published|published|paper_form"),
    ("bridges: bluesky, secop", r"plugins/(bluesky|secop)", r"secop|bluesky|serve_as"),
    ("shadow (reads beside a person)", r"shadow", r"shadow"),
    ("drift: frame, tracker, estimators", r"plugins/drift/(?!report)", r"tests/plugins/drift|drift"),
    ("drift: pictures and reports", r"plugins/drift/report", r""),
    ("line watch", r"plugins/line_watch", r"line_watch"),
    ("adaptive measuring", r"plugins/adaptive", r"adaptive"),
    (
        "replay component, image, trace replay",
        r"plugins/(replay|image)|emulation/(replay|playback)|translator/trace",
        r"replay|playback|trace",
    ),
    (
        "page in the browser",
        r"plugins/web/dashboard|plugins/web/(watch|frames|archive|person|asgi|server|passwords|component|commands)",
        r"tests/ui|plugins/web/test_(?!gateway)|dashboard",
    ),
    ("HTTP gateway", r"plugins/web/gateway", r"gateway"),
    (
        "emulators of five makers",
        r"plugins/\w+/emulator",
        r"plugins/\w+/test_\w*emulat|system/emulators|unit/emulation",
    ),
    ("nion driver (proof)", r"afspm-nion", r"afspm-nion"),
    ("drivers: Nanonis", r"plugins/nanonis", r"nanonis"),
    ("drivers: GXSM", r"plugins/gxsm", r"gxsm"),
    ("drivers: Asylum", r"plugins/asylum", r"asylum"),
    ("drivers: Nanosurf", r"plugins/nanosurf", r"nanosurf"),
    ("drivers: Park", r"plugins/park", r"park"),
    ("kit of emulators", r"simulation/emulation|afspm/emulation/", r""),
    ("simulated microscope", r"afspm/simulation/", r"unit/simulation|system/microscopes"),
    (
        "translator: proof of results, panel watch",
        r"translator/(judge|claims|panel_watch|wished_feedback|treatment_end|temporary)|model/panel|control/panel_state",
        r"judge|claims|panel|wished|proof|acts_",
    ),
    ("translator: held z", r"held_z|held_height", r"held|hold_z"),
    ("translator: core and driver base", r"afspm/translator/|afspm/driver/", r"unit/translator|system/translator"),
    (
        "safety: limits, rules, watchdog",
        r"scheduler/safety|default_limits|limits_section|scheduler/instruments",
        r"limit|watchdog|rule_lang|forbidden|movers|conditions|safe_exit",
    ),
    (
        "recovery from kills, disks",
        r"storage/(atomic|disk|memory|segment|packet_log)|write_ahead|saved_state|idempotency|model/fencing|keyed_results|model/snapshot",
        r"unit/storage|kill|crash|power|disk|memory|keyed|snapshot|idempot",
    ),
    ("scheduler: core, control, requests", r"afspm/scheduler", r"unit/scheduler|system/scheduler"),
    ("wire and transport", r"afspm/(wire|transport)", r"unit/(wire|transport)|system/(process|hosts)"),
    ("client core", r"afspm/client|afspm/__init__|__main__", r"unit/client|system/client"),
    ("components: tip", r"components/(tip_|feedback_|channel_pairs)", r"tip_|feedback"),
    (
        "components: plans, survey, sweep, grids",
        r"afspm/components/",
        r"unit/components|unit/surveying|system/components|survey|sweep",
    ),
    ("experiment file", r"afspm/experiment", r"unit/experiment|system/experiment"),
    ("supervisor", r"afspm/supervisor", r"supervis"),
    ("CLI", r"afspm/cli", r"/cli"),
    ("record (NeXus, journal)", r"afspm/record|storage/formats|report/export", r"/record|/formats|real_data|export"),
    ("night (read and reduce)", r"afspm/night", r"unit/night"),
    ("report, pictures, drawing", r"afspm/(report|drawing)", r"unit/(report|drawing)"),
    ("commissioning", r"testing/commissioning", r"commission"),
    (
        "kit: suite for drivers",
        r"testing/translators|testing/skeletons",
        r"system/translators|system/matrix|testing/test_\w*(translator|driver|maker)",
    ),
    ("kit: suite for clients in other languages", r"testing/clients", r"octave|conformance|plain_client"),
    ("kit: bench for components, nights", r"afspm/testing", r"unit/testing|tests/simulation"),
    ("model", r"afspm/model", r"unit/model"),
    ("basics", r"afspm/basics", r"unit/basics"),
)
"""Capability, paths in src and packages, paths of tests; an empty pattern matches nothing."""


class Sums(NamedTuple):
    """Lines, and lines of code among them."""

    lines: int = 0
    code: int = 0

    def __add__(self, other: tuple[int, ...]) -> Sums:  # type: ignore[override]  # a sum of numbers, not of tuples
        return Sums(self.lines + other[0], self.code + other[1])


class Bill(NamedTuple):
    """Sums by capability (src and packages, tests) and by folder, and words of docs."""

    capabilities: dict[str, tuple[Sums, Sums]]
    folders: dict[str, Sums]
    words: dict[str, int]


def code_lines(text: str) -> int:
    try:
        tree = ast.parse(text)
    except SyntaxError:
        return len(text.splitlines())  # a template
    documented = set[int]()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module) and node.body:
            first = node.body[0]
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                documented |= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    stripped = ((number, line.strip()) for number, line in enumerate(text.splitlines(), 1))
    return sum(1 for number, line in stripped if line and line[0] != "#" and number not in documented)


def is_test(path: str) -> bool:
    return path.startswith("tests/") or "/tests/" in path


def capability(path: str) -> str:
    which = 2 if is_test(path) else 1
    return next((rule[0] for rule in RULES if rule[which] and re.search(rule[which], path)), "other")


def bill(files: dict[str, str]) -> Bill:
    """Return the bill of text files by path."""
    capabilities, folders = defaultdict[str, tuple[Sums, Sums]](lambda: (Sums(), Sums())), defaultdict[str, Sums](Sums)
    words = dict.fromkeys(("how-to and explanation without decisions", "all docs"), 0)
    for path, text in files.items():
        if path.endswith(".md") and path.startswith("docs/"):
            words["all docs"] += len(text.split())
            if path.startswith(("docs/how-to/", "docs/explanation/")) and "/decisions/" not in path:
                words["how-to and explanation without decisions"] += len(text.split())
        elif Path(path).suffix in _PROGRAMS and "/generated/" not in path:
            is_python = path.endswith(".py")
            sums = Sums(len(text.splitlines()), code_lines(text) if is_python else 0)
            folders["tests" if is_test(path) else path.split("/")[0]] += sums
            if is_python and not path.startswith("clients/"):
                own, tests = capabilities[capability(path)]
                capabilities[capability(path)] = (own, tests + sums) if is_test(path) else (own + sums, tests)
    return Bill(capabilities, folders, words)


def files_now() -> dict[str, str]:
    """Return the files that git tracks or would add, as they are."""
    listed = _git("ls-files", "-co", "--exclude-standard", "-z", *_COUNTED).decode().split("\0")
    return {path: _text((ROOT / path).read_bytes()) for path in listed if path and (ROOT / path).is_file()}


def files_at(revision: str) -> dict[str, str]:
    with tarfile.open(fileobj=io.BytesIO(_git("archive", revision, *_COUNTED))) as archive:
        members = [(one.name, archive.extractfile(one)) for one in archive if one.isfile()]
        return {name: _text(file.read()) for name, file in members if file is not None}


def table(now: Bill, before: Bill) -> list[str]:
    """Return the lines of the table: the numbers of now, and the growth of each that is not the same as before."""
    rows = [f"{'lines of code by capability':46}{'code':>14}{'its tests':>16}"]
    for name, (own, tests) in sorted(now.capabilities.items(), key=lambda item: -item[1][0].code):
        was = before.capabilities.get(name, (Sums(), Sums()))
        rows.append(f"{name:46}{_grown(own.code, was[0].code)}  {_grown(tests.code, was[1].code)}")
    rows += ["", f"{'folder':46}{'all lines':>14}{'code':>16}"]
    for name, sums in sorted(now.folders.items()):
        was_sums = before.folders.get(name, Sums())
        rows.append(f"{name:46}{_grown(sums.lines, was_sums.lines)}  {_grown(sums.code, was_sums.code)}")
    rows += [f"{'words: ' + name:46}{_grown(count, before.words[name])}" for name, count in now.words.items()]
    return rows


def _grown(now: int, before: int) -> str:
    return f"{now:7}{f'{now - before:+7}' if now != before else '':7}"


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def _git(*args: str) -> bytes:
    return subprocess.run(["git", *args], cwd=ROOT, capture_output=True, check=True).stdout


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--base", default=_LANDED.read_text(encoding="utf-8").strip(), help="the commit to compare with"
    )
    base = parser.parse_args().base
    now = bill(files_now())
    try:
        before, beside = bill(files_at(base)), f"beside {base}"
    except subprocess.CalledProcessError as error:
        # a shallow clone lacks the commit: the numbers of now are still worth printing
        before, beside = now, f"not compared with {base}: {error.stderr.decode().strip()}"
    sys.stdout.write("\n".join([f"The bill, {beside}", *table(now, before), ""]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
