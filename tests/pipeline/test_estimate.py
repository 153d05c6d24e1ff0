"""What a dry run says, of pilots that fail too; how far it is right `tests.pipeline.estimates` measures."""

from __future__ import annotations

import contextlib
import os
from concurrent.futures import Future

import pytest

from stickslip.pipeline import ScheduleError, design, estimate
from stickslip.workflows.progress import in_words


class Here:
    """A pool of processes that is this process."""

    def submit(self, work, *arguments):
        done = Future()
        done.set_result(work(*arguments))
        return done


@pytest.fixture
def batches(scene, monkeypatch):
    monkeypatch.setattr(estimate, "_workers", lambda count: contextlib.nullcontext(Here()))
    return [batch for batch, _ in design.tasks(scene)]


def test_a_pilot_that_fails_gives_a_reason_and_no_interval(scene, batches, monkeypatch):
    task = design.Member.task

    def fragile(member, *args):
        if member.n == 5 and member.engine == "coulomb":
            raise MemoryError("no room for K")
        return task(member, *args)

    monkeypatch.setattr("stickslip.pipeline.design.Member.task", fragile)
    found = estimate.estimate(scene, batches, 2)
    assert found.amounts is None
    assert list(found.failures) == ["MemoryError: no room for K"]
    n_failed = sum(found.failures.values())
    assert 0 < n_failed < found.n_pilot  # those of the other kinds ended
    lines = in_words(found)
    assert lines[0] == f"time    not known, nor is disk: {n_failed} of the pilot's {found.n_pilot} members failed"
    assert lines[1] == f"failed  {n_failed}: MemoryError: no room for K"
    assert not any(line.startswith(("disk", "start")) for line in lines)


def test_a_pilot_whose_process_dies_is_refused_in_words():
    with pytest.raises(ScheduleError, match="expected the members of the pilot to end, got one whose process died"):
        _die()


def _die():
    with estimate._workers(1) as pool:
        pool.submit(os._exit, 1).result()


def test_workers_are_as_many_as_there_are_shards_and_cores(scene, batches, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.delattr(os, "sched_getaffinity")  # which macOS has not
    assert len(batches) > 3
    for count, workers, words in (
        (1, 4, "on 1 worker, not counting the report"),
        (2, 3, "on 2 workers, not counting the report"),
        (3, 1, "on 1 worker, not counting the report"),
        (3, 2, "on 2 workers, not counting the report"),
        (3, 8, "on 3 workers (which share 2 cores), not counting the report"),
    ):
        found = estimate.estimate(scene, batches[:count], workers)
        assert words in in_words(found)[0]
        assert found.failures == {}
        low, middle, high = found.amounts.seconds
        assert 0 < low < middle < high
