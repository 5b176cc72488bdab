"""The run of all checks of a client, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from afspm.clock import ExperimentClock
from afspm.errors import AfspmError, ConfigError
from afspm.supervisor import run_folder
from afspm.testing.clients.bench import ClientBench
from afspm.testing.clients.registry import ClientCheck, all_client_checks
from afspm.testing.clients.report import ClientReport
from afspm.testing.verdicts import CheckOutcome, CheckResult, Failed, Lost

REPORT_FILE = "report.json"


def chosen_checks(only: Collection[str] = ()) -> list[ClientCheck]:
    """Return the checks whose names have one of these in them; all, if none are given.

    Raises:
        ConfigError: there are none.
    """
    found = [one for one in all_client_checks() if not only or any(part in one.name for part in only)]
    if not found:
        raise ConfigError(f"there is no check {' or '.join(only)}", hint="afspm test-client --list")
    return found


def judge(
    command: Sequence[str],
    runs: Path,
    only: Collection[str] = (),
    done: Callable[[CheckResult], None] = lambda result: None,
) -> ClientReport:
    """Do all checks that are chosen, and write `report.json` into a new folder in `runs`.

    Args:
        command: the client's conformance program, and its arguments.
        only: parts of the names of the checks to do; empty: all.
        done: told of each result.

    Raises:
        ConfigError: the program can't be started, or there are no such checks.
    """
    wanted = chosen_checks(only)
    now = datetime.fromtimestamp(ExperimentClock.real().now_s(), UTC)
    folder = run_folder.create(runs, "test-client", now.astimezone())
    report = ClientReport(command, version("afspm"), now.isoformat(timespec="seconds"), str(folder))
    bench = ClientBench(command, folder)
    try:
        for check in wanted:
            result = _do(check, bench)
            report.results.append(result)
            done(result)
    except Lost as lost:
        report.lost = str(lost)
    except KeyboardInterrupt:
        report.lost = "interrupted"
        raise
    finally:
        bench.close()
        (folder / REPORT_FILE).write_text(report.to_json(), encoding="utf-8")
    return report


def _do(check: ClientCheck, bench: ClientBench) -> CheckResult:
    began_s = bench.clock.monotonic_s()

    def result(outcome: CheckOutcome, line: str = "", *more: str) -> CheckResult:
        return CheckResult(check.name, check.title, outcome, line, bench.clock.monotonic_s() - began_s, more)

    try:
        told = check.do(bench)
    except Failed as failure:
        bench.begin_anew()
        return result(CheckOutcome.FAILED, str(failure), f"→ {check.remedy}")
    except ConfigError:
        raise
    except AfspmError as error:  # what the judge itself wanted to do was not possible, with this client beside it
        bench.begin_anew()
        return result(CheckOutcome.FAILED, f"the experiment with the client in it: {error}", f"→ {check.remedy}")
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        bench.begin_anew()
        line = f"expected an answer as the page of steps describes it; came one that can't be read ({error!r})"
        return result(CheckOutcome.FAILED, line, f"→ {check.remedy}")
    return result(CheckOutcome.PASSED, told or "")
