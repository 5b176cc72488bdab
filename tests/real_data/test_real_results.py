"""The rules of the judge over files of real microscopes: none contradicts a whole measurement."""

from __future__ import annotations

import logging
import re
import shutil
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from benchmarks.data_folder import DATA

from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import AfspmError
from afspm.plugins.gxsm.result_files import LATE_S, SOON_S, GxsmFiles
from afspm.storage.formats import FileContent, read
from afspm.translator.judge import RULES, Claim, Stated, Witness, judge

_CHANNEL = re.compile(r"(-M)?-X[pm]-.*$")
CASES = DATA.parent / "cases" / "gxsm" / "results"


def stated(files: list[FileContent], before: dict[int, int]) -> Stated:
    began_ns = tuple(one.start_ns for one in files if one.start_ns is not None)
    return Stated(began_ns, tuple(one.end_ns for one in files if one.end_ns is not None), before)


def measurements(folder: Path) -> dict[tuple[str, str], list[FileContent]]:
    """Return the files of each measurement in a folder, by (maker, name); GXSM has one for each channel."""
    found = defaultdict[tuple[str, str], list[FileContent]](list)
    for file in sorted(folder.rglob("*.*")):
        try:
            content = read(file)
        except (AfspmError, OSError, ValueError, KeyError):
            continue
        name = _CHANNEL.sub("", file.name) if content.controller.startswith("GXSM") else file.name
        found[content.controller, f"{file.parent}/{name}"].append(content)
    return found


def test_no_rule_contradicts_a_whole_measurement_of_a_real_microscope(capsys: pytest.CaptureFixture[str]) -> None:
    found = measurements(DATA)
    contradicted, counts = [], dict.fromkeys(((rule, maker) for rule in RULES for maker, _ in found), 0)
    before: dict[str, dict[int, int]] = defaultdict(dict)
    for (maker, name), files in found.items():
        said = stated(files, before[maker])
        claim = Claim(max(said.began_ns, default=0))
        verdict = judge(claim, Witness(), said)
        if verdict.rule:
            counts[verdict.rule, maker] += 1
            contradicted.append((name, verdict.sentence))
        before[maker] |= dict.fromkeys(said.began_ns, max(said.ended_ns, default=0))
    with capsys.disabled():
        for (rule, maker), count in sorted(counts.items()):
            print(f"{rule:20} {maker:10} {count} of {sum(one == maker for one, _ in found)}")  # noqa: T201
    assert len(found) > 15
    assert not contradicted


# results X1, X2
@pytest.mark.parametrize(
    ("pattern", "rule"), [("between029*", ""), ("between057*", "one start"), ("zz030*", "end after start")]
)
def test_rules_find_what_the_real_gxsm_made_of_a_persons_acts(pattern: str, rule: str) -> None:
    files = [read(file) for file in sorted(CASES.glob(pattern))]
    if not files:
        pytest.skip(f"{CASES} is not there")
    said = stated(files, {})
    assert judge(Claim(max(said.began_ns)), Witness(), said).rule == rule


FIRST, SECOND = "between057-M-Xp-ZSmTopo.nc", "between057-Xp-ImTunnel.nc"


@pytest.mark.skipif(not CASES.is_dir(), reason="no files of a real Gxsm4 beside the repository")
@pytest.mark.parametrize(
    ("there", "earlier", "own", "rule"),
    [
        (["between030-M-Xp-ZSmTopo.nc", "zz030-M-Xp-ZSmTopo.nc"], ["between029-M-Xp-ZSmTopo.nc"], 0, ""),
        ([FIRST, SECOND], ["between054-M-Xp-ZSmTopo.nc"], 1, "one start"),
        ([FIRST], ["between054-M-Xp-ZSmTopo.nc"], 0, "new start"),
        ([FIRST], [], 0, "own start"),
    ],
)
def test_files_of_the_real_gxsm(tmp_path: Path, there: list[str], earlier: list[str], own: int, rule: str) -> None:
    kept: dict[str, Any] = {}
    files = GxsmFiles(kept, logging.getLogger(), patience_s=10.0, soon_s=SOON_S, late_s=LATE_S)

    def taken(names: list[str], start_ns: int, end_ns: int) -> str:
        frame = {"frame": [0.0, 0.0, 1e-8, 1e-8, 0.0], "shape": [150, 32], "place": []}
        files.begin("scan", tmp_path, start_ns, frame, own=True)
        paths = [Path(shutil.copy(CASES / name, tmp_path)) for name in names]
        files.end(end_ns, end_ns, [str(path) for path in paths if path.name.startswith("between")])
        files.results(0.0)
        return files.results(0.0)[-1]

    for name in earlier:
        before = read(CASES / name)
        taken([name], before.start_ns or 0, before.end_ns or 0)
    # the other scans before it are not among these files
    whole = read(CASES / (SECOND if there[0] == FIRST else there[0]))
    start_ns, end_ns = whole.start_ns or 0, whole.end_ns or 0
    kept["starts"] = [start_ns - 8 * NS_PER_S]
    result = taken(there, start_ns, end_ns)
    assert judge(Claim(start_ns), Witness(), files.stated(result)).rule == rule
    assert {scan.filename for scan in files.load(result)} == {str(tmp_path / name) for name in there[: own + 1]}
