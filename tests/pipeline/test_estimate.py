"""What a dry run says: of how many workers, of disk as the run takes it, and of members that fail."""

from __future__ import annotations

import math
import os
import time

import pytest

from stickslip.pipeline import status
from stickslip.pipeline.ensemble import pack
from stickslip.pipeline.running import worker
from stickslip.pipeline.running.estimate import estimate


@pytest.fixture(autouse=True)
def short_pilot(monkeypatch):
    monkeypatch.setattr("stickslip.pipeline.running.estimate.PILOT", 0.5)


@pytest.fixture
def batches(scene):
    return pack.tasks(scene)


def test_disk_is_as_the_run_takes_it_and_time_that_of_its_workers(scene, batches, finished):
    found = estimate(scene, batches, 1)
    assert found.failures == {}
    assert found.n_bytes == pytest.approx(status(finished).n_bytes, rel=0.5)
    assert 0 < found.core_seconds == found.seconds < math.inf


def test_what_a_first_run_compiles_is_not_counted(scene, monkeypatch):
    """Each point of a sweep takes a tenth of a second when it is first met, as one with the first force may."""
    swept = scene.changed(system={"belt_speed": [-0.1, -0.2, -0.3]})
    batches = pack.tasks(swept)
    plain, met, run = estimate(swept, batches, 1), set(), worker.run_members

    def compiling(members, recording):
        for member in members:
            point = member.n, member.engine, member.settings, member.term("belt_speed")
            if point not in met:
                met.add(point)
                until = time.process_time() + 0.1
                while time.process_time() < until:
                    pass
        return run(members, recording)

    monkeypatch.setattr("stickslip.pipeline.running.estimate.run_members", compiling)
    assert estimate(swept, batches, 1).core_seconds < 10 * plain.core_seconds
    assert len(met) > 3


def test_members_that_fail_are_told_by_reason(scene, batches, fragile):
    with fragile(MemoryError("no room for K")):
        assert list(estimate(scene, batches, 2).failures) == ["MemoryError: no room for K"]


@pytest.mark.parametrize(("count", "workers", "expected"), [(1, 4, 1), (2, 3, 2), (3, 1, 1), (3, 2, 2), (3, 8, 2)])
def test_workers_are_as_many_as_there_are_shards_and_cores(count, workers, expected, scene, batches, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.delattr(os, "sched_getaffinity")  # which macOS has not
    assert len(batches) > 3
    assert estimate(scene, batches[:count], workers).workers == expected
