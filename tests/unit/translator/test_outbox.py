"""Results of the controller: none is lost by a kill, and none is published under two times."""

from __future__ import annotations

import itertools
import json
import logging
from typing import Any

from afspm.model import MeasurementConditions
from afspm.translator.outbox import KEPT_FOR_REPLAY, Outbox


def outbox(microscope: Any, kept: Any) -> Outbox:
    times = itertools.count(1)
    return Outbox(microscope, kept, lambda count: list(itertools.islice(times, count)), logging.getLogger("outbox"))


def test_all_results_taken_before_a_kill_are_published_again_at_their_times(make_bench: Any, scan: Any) -> None:
    microscope, kept = make_bench().microscope, dict[str, Any]()
    before = outbox(microscope, kept)
    assert before.start() == []
    microscope.files |= {"a": [scan()], "b": [scan()]}
    assert before.look()
    taken = before.take(MeasurementConditions)
    assert len(taken) == 4  # each with its conditions
    # the kill: the saved memory is all that the next process has
    assert outbox(microscope, json.loads(json.dumps(kept))).start() == taken


def test_published_results_are_kept_for_the_scheduler_up_to_a_number(make_bench: Any, scan: Any) -> None:
    microscope, kept = make_bench().microscope, dict[str, Any]()
    before = outbox(microscope, kept)
    before.start()
    taken = []
    for number in range(KEPT_FOR_REPLAY + 2):
        microscope.files[f"{number}"] = [scan()]
        before.look()
        taken += before.take(MeasurementConditions)
    assert outbox(microscope, json.loads(json.dumps(kept))).start() == taken[4:]
