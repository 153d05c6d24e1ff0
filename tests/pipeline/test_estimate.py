"""What a dry run says: of how many workers, of disk as the run takes it, and of members that fail."""

from __future__ import annotations

import math
import os

import pytest

from stickslip.pipeline import design, status
from stickslip.pipeline.estimate import estimate


@pytest.fixture
def batches(scene):
    return [batch for batch, _ in design.tasks(scene)]


def test_disk_is_as_the_run_takes_it_and_time_that_of_its_workers(scene, batches, finished):
    found = estimate(scene, batches, 1)
    assert found.failures == {}
    assert found.n_bytes == pytest.approx(status(finished).n_bytes, rel=0.5)
    assert 0 < found.core_seconds == found.seconds < math.inf


def test_members_that_fail_are_told_by_reason(scene, batches, monkeypatch):
    task = design.Member.task

    def fragile(member, *args):
        if member.n == 5 and member.engine == "coulomb":
            raise MemoryError("no room for K")
        return task(member, *args)

    monkeypatch.setattr("stickslip.pipeline.design.Member.task", fragile)
    assert list(estimate(scene, batches, 2).failures) == ["MemoryError: no room for K"]


@pytest.mark.parametrize(("count", "workers", "expected"), [(1, 4, 1), (2, 3, 2), (3, 1, 1), (3, 2, 2), (3, 8, 2)])
def test_workers_are_as_many_as_there_are_shards_and_cores(count, workers, expected, scene, batches, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.delattr(os, "sched_getaffinity")  # which macOS has not
    assert len(batches) > 3
    assert estimate(scene, batches[:count], workers).workers == expected
