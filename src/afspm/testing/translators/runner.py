"""Does the checks one after the other, and puts everything back."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import version

from afspm.clock import Clock, ExperimentClock
from afspm.errors import ConfigError
from afspm.testing.translators.registry import Check, all_checks
from afspm.testing.translators.report import Outcome, Report, Result
from afspm.testing.translators.restoring import Before
from afspm.testing.translators.session import Options, Session, opened
from afspm.testing.translators.taking import Taking
from afspm.testing.translators.verdicts import Failed, Lost, Skipped

REPORT_FILE = "report.json"


def chosen(only: Collection[str] = ()) -> list[Check]:
    """The checks whose names have one of these in them; all, if none are given.

    Raises:
        ConfigError: there are none.
    """
    found = [one for one in all_checks() if not only or any(part in one.name for part in only)]
    if not found:
        raise ConfigError(f"there is no check {' or '.join(only)}", hint="afspm test-translator --list")
    return found


def do(check: Check, kit: Taking) -> Result:
    """Do one.

    Raises:
        Lost: nothing more can be checked.
    """
    clock: Clock = kit.bench.clock
    began_s, heard = clock.monotonic_s(), len(kit.complaints)

    def result(outcome: Outcome, line: str = "") -> Result:
        meanwhile = tuple(kit.complaints[heard:]) if outcome is Outcome.FAILED else ()
        return Result(check.name, check.title, outcome, line, clock.monotonic_s() - began_s, meanwhile)

    missing = kit.support.missing(check.needs)
    if missing:
        return result(Outcome.SKIPPED, f"not supported: {', '.join(missing)}")
    try:
        check.do(kit)
        return result(Outcome.PASSED)
    except Failed as failure:
        if check.name in kit.excused:
            return result(Outcome.SKIPPED, f"{kit.excused[check.name]}: {failure}")
        return result(Outcome.FAILED, str(failure))
    except Skipped as skipped:
        return result(Outcome.SKIPPED, str(skipped))


@contextmanager
def restored(session: Session, report: Report) -> Iterator[Taking]:
    """What is in force when the block begins is so again at its end, however that comes."""
    kit = Taking(
        session.bench, session.support, session.options.frame_m, excused=session.excused, complaints=session.complaints
    )
    before = Before.of(session.bench, session.support)
    try:
        yield kit
    finally:
        report.unrestored = before.restore(session.bench)


def begin_report(session: Session) -> Report:
    """A report with nothing checked yet."""
    return Report(
        translator=session.translator,
        simulated=session.simulated,
        afspm=version("afspm"),
        began=datetime.fromtimestamp(ExperimentClock.real().now_s(), UTC).isoformat(timespec="seconds"),
        support=session.support,
        folder=str(session.folder),
    )


def run(
    options: Options,
    begun: Callable[[Report], None] = lambda report: None,
    doing: Callable[[Check], None] = lambda check: None,
    done: Callable[[Result], None] = lambda result: None,
) -> Report:
    """Do all checks that are chosen, restore, and write `report.json` into the run's folder.

    Args:
        begun, doing, done: told of how it goes.

    Raises:
        ConfigError: the experiment file or the options are wrong; nothing was started.
        KeyboardInterrupt: after everything was put back, and the report of what was done was written.
    """
    wanted = chosen(options.only)
    report = Report()
    try:
        with opened(options) as session:
            report = begin_report(session)
            begun(report)
            try:
                with restored(session, report) as kit:
                    for check in wanted:
                        doing(check)
                        result = do(check, kit)
                        report.results.append(result)
                        done(result)
                    session.support.ask_again(session.bench)
            except KeyboardInterrupt:
                report.lost = "interrupted"
                raise
            finally:
                (session.folder / REPORT_FILE).write_text(report.to_json(), encoding="utf-8")
    except Lost as lost:
        report.lost = str(lost)
    return report
