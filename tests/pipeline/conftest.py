"""A small scene that has everything, split into many shards, and its finished dataset."""

from __future__ import annotations

import contextlib
import shutil

import pytest

from stickslip.pipeline import parse_scene, run_ensemble
from stickslip.pipeline.ensemble import pack
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.own import trial
from tests.pipeline import trials
from tests.scenes import COULOMB, SIGMOID, ensemble

SOURCE = ensemble(
    [5, 3],
    8.0,
    3,
    COULOMB,
    f'{SIGMOID}\nratio = "uniform"\nratio_draws = 2\nstick = "threshold"',
    seed=7,
    rest="[perturbation]\nsizes = [0.05, 0.01]\n\n[record]\nevents = true",
).encode()


#: Three or so members a shard: a small scene then has many.
SMALL_BATCHES = 3.5e-3


@pytest.fixture(autouse=True)
def small_batches(monkeypatch):
    monkeypatch.setattr(pack, "TARGET_COST", SMALL_BATCHES)


@pytest.fixture(autouse=True, scope="session")
def kept_children():
    """A function is tried in two processes whenever its scene is read; to start them takes longer than all else."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trial, "Child", trials.Kept.next)
        yield
    trials.Kept.end()


@pytest.fixture(scope="session")
def source():
    return SOURCE


@pytest.fixture(scope="session")
def scene(source):
    return parse_scene(source)


@pytest.fixture(scope="session")
def finished(scene, source, tmp_path_factory):
    """The finished dataset, computed in this process; not to be changed."""
    path = tmp_path_factory.mktemp("finished") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pack, "TARGET_COST", SMALL_BATCHES)
        run_ensemble(scene, path, workers=0)
    return path


@pytest.fixture
def copy(finished, tmp_path):
    """A copy of the finished dataset, to be spoilt."""
    return shutil.copytree(finished, tmp_path / "copy")


@pytest.fixture
def fragile(monkeypatch):
    """Within: some members fail with an error."""

    @contextlib.contextmanager
    def failing(error, fails=lambda member: member.n == 5 and member.engine == "coulomb"):
        task = Member.task

        def fragile_task(member, *rest):
            if fails(member):
                raise error
            return task(member, *rest)

        with monkeypatch.context() as patch:
            patch.setattr(Member, "task", fragile_task)
            yield

    return failing


@pytest.fixture(scope="session")
def content():
    """Every byte of a dataset but the timings, by file."""

    def read(path):
        files = sorted(file for file in path.rglob("*") if file.is_file() and not file.name.startswith("timings"))
        return {str(file.relative_to(path)): file.read_bytes() for file in files}

    return read
