"""Functions that questions put to runs, computed shard by shard on workers, in any order."""

import contextlib
import pickle

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis.page.parts import ask
from stickslip.analysis.questions import package_questions
from stickslip.pipeline import parse_scene, run_ensemble
from stickslip.pipeline.dataset import opened
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.ensemble import pack
from stickslip.pipeline.machine.processes import ChildDied
from stickslip.pipeline.query import frames, series
from stickslip.pipeline.running import executor
from stickslip.pipeline.running.executor import Executor
from stickslip.workflows import asking
from stickslip.workflows.commands import main
from stickslip.workflows.parts import Parts
from stickslip.workflows.reporting import report, study_of
from tests.scenes import COULOMB, ensemble


def scene(n, t_end, t_burn):
    return parse_scene(ensemble(
        n, t_end, 12, COULOMB, seed=3, rest="[record]\nevents = true",
        analysis=f't_burn = {t_burn}\ndt = [0.5]\nresamples = 20\nquestion = ["cascades", "counting", "definitions"]',
    ).encode())  # fmt: skip


def in_shards_of(out, *numbers):
    """A dataset of several shards."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pack, "TARGET_COST", 0.002)
        run_ensemble(scene(*numbers), out, workers=0)
    assert len(open_dataset(out).manifest.shards) > 3
    assert sum(group.n_moving for group in study_of(out).groups) > 3
    return out


@pytest.fixture(scope="module")
def in_shards(tmp_path_factory):
    return in_shards_of(tmp_path_factory.mktemp("shards") / "small", 20, 40.0, 5.0)


class Shuffled(Executor):
    """In place of a cluster: every part in this process, out of order."""

    def __init__(self, rng):
        self._rng = rng

    def map(self, function, parts):
        parts = list(parts)
        for k in self._rng.permutation(len(parts)):
            yield [(k, pickle.loads(pickle.dumps(function(pickle.loads(pickle.dumps(parts[k]))))))]


def put(opened, executor, least=1):
    return Parts(opened, study_of(opened).settings, executor, least)


def test_what_workers_find_is_what_one_process_finds(in_shards, rng):
    plain, opened = report(in_shards), open_dataset(in_shards)

    def ask_on_workers(opened, study, on_answer):
        study.put = put(opened, Shuffled(rng))
        return [ask(study, key) for key in package_questions(study.settings.question)]

    spread = report(opened, ask_on_workers)
    assert spread.tables.keys() == plain.tables.keys() >= {"law"}
    for name, table in plain.tables.items():
        pd.testing.assert_frame_equal(spread.tables[name], table, rtol=1e-10)


def test_every_run_is_asked_once_whatever_is_asked_for(in_shards, rng):
    study = study_of(in_shards)
    study.put = put(open_dataset(in_shards), Shuffled(rng))
    for group in study.groups:
        assert study.sums(group, counted, 1)[:, 1].tolist() == np.bincount(group.moving["unit"])[group.units].tolist()


def counted(run):
    return np.array([run.win.t_stop])


def divided(run):
    return np.array([1 // int(run.win.t_start - run.win.t_start)])


@contextlib.contextmanager
def children(*lives):
    """Processes that die after so many calls: in this one."""

    class Mortal:
        def __init__(self):
            self._n_calls = next(calls)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def kill(self):
            self._n_calls = 0

        def __call__(self, *task):
            if self._n_calls == 0:
                raise ChildDied("signal SIGKILL")
            self._n_calls -= 1
            function, *arguments = pickle.loads(pickle.dumps(task))
            return function(*arguments)

    calls = iter(lives)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(executor, "Child", Mortal)
        with executor.Children(len(lives), nothing) as found:
            yield found


def nothing():
    """What children load."""


@pytest.mark.parametrize("lives", [(), (0,), (3, 2), (1000, 1)])
def test_processes_beside_this_one_may_die(in_shards, lives):
    alone, study = study_of(in_shards), study_of(in_shards)
    with children(*lives) as beside:
        study.put = put(open_dataset(in_shards), beside, least=7)
        for mine, theirs in zip(alone.groups, study.groups, strict=True):
            assert (mine.fates == theirs.fates).all()
            np.testing.assert_array_equal(mine.counts, theirs.counts)
            for name, column in mine.totals.items():
                np.testing.assert_allclose(column, theirs.totals[name], rtol=1e-12)
            assert study.sums(theirs, counted, 1).tolist() == alone.sums(mine, counted, 1).tolist()


def test_what_a_process_dies_of_is_seen_here(in_shards):
    study = study_of(in_shards)
    with children(0, 1) as beside:
        study.put = put(open_dataset(in_shards), beside, least=7)
        (group,) = [group for group in study.groups if group.n_moving]
        with pytest.raises(ZeroDivisionError):
            study.sums(group, divided, 1)


def test_a_report_of_many_runs_is_that_of_few(in_shards, monkeypatch):
    """From some number on processes share the runs, and the table of members is read in parts."""
    plain = report(in_shards)
    monkeypatch.setattr(opened, "MANY", 1)
    monkeypatch.setattr(asking, "_LEAST", 7)
    monkeypatch.setattr(frames, "_ROWS", 11)
    with asking.Asking() as put:
        many = report(in_shards, put)
    assert many.tables.keys() == plain.tables.keys() >= {"law"}
    for name, table in plain.tables.items():
        pd.testing.assert_frame_equal(many.tables[name], table, rtol=1e-10)


def test_series_of_many_runs_are_those_of_each(in_shards, rng):
    """In any order, of any of them, once or twice, with as few shards in memory as can be."""
    every = dict(series(in_shards).items())
    names = np.array(list(every))
    orders = [names, names[::-1], names[::3], rng.permutation(names), rng.choice(names, 40), names[:1], names[:0]]
    for some in orders:
        found = series(in_shards)
        for order in (some, names):
            parts = list(found.stacks(order.tolist()))
            t, n_stick = (np.concatenate([part[k] for part in parts] or [[]]) for k in (1, 2))
            lengths = np.concatenate([np.diff(first) for first, _, _ in parts] or [[]])
            assert lengths.tolist() == [len(every[name][0]) for name in order]
            assert t.tolist() == [x for name in order for x in every[name][0]]
            assert n_stick.tolist() == [x for name in order for x in every[name][1]]
    with pytest.raises(KeyError, match="nobody"):
        list(series(in_shards).stacks([str(names[0]), "nobody"]))


def test_copies_are_beside_their_bases_wherever_these_lie(tmp_path, rng, monkeypatch):
    """With every member a shard, and a part, of its own."""
    monkeypatch.setattr(pack, "TARGET_COST", 1e-9)
    run_ensemble(parse_scene(ensemble(
        60, 80.0, 9, COULOMB, seed=2,
        rest="[twins]\nsizes = [1e-6, 1e-2]\n[perturbation]\nsizes = [0.01, 0.1]",
        analysis='t_burn = 20.0\ndt = [0.5]\nquestion = ["sensitivity", "robustness"]',
    ).encode()), tmp_path, workers=0)  # fmt: skip
    plain, opened = report(tmp_path), open_dataset(tmp_path)
    assert len(opened.manifest.shards) == opened.n_members

    def spread(executor):
        def asked(opened, study, on_answer):
            study.put = put(opened, executor)
            return [ask(study, key) for key in package_questions(study.settings.question)]

        return report(opened, asked)

    with children(3, 1000) as beside:
        pages = [spread(executor) for executor in (Shuffled(rng), beside)]
    for found in pages:
        assert found.tables.keys() == plain.tables.keys() >= {"changes"}
        for name, table in plain.tables.items():
            pd.testing.assert_frame_equal(found.tables[name], table, rtol=1e-10)
        said, expected = ([row["sentence"] for row in page.findings["findings"]] for page in (found, plain))
        assert said == expected
        assert any("differ from the original" in sentence for sentence in said)


@pytest.mark.long
def test_a_report_by_workers_of_this_machine_is_that_of_one_process(tmp_path):
    out = in_shards_of(tmp_path / "moving", 200, 300.0, 100.0)
    found = []
    for options in ((), ("--workers", "2")):
        assert main(["report", str(out), *options]) == 0
        found.append({file.name: pd.read_parquet(file) for file in (out / "report").glob("*.parquet")})
        (out / "report.html").unlink()
    plain, spread = found
    asked = {"law", "definitions", "clustering", "spectrum"}
    assert plain.keys() == spread.keys() >= {f"{name}.parquet" for name in asked}
    for name, table in plain.items():
        pd.testing.assert_frame_equal(spread[name], table, rtol=1e-10)


def test_a_scheduler_that_is_not_there_is_refused_by_name(in_shards, capsys):
    (in_shards / "report.html").unlink(missing_ok=True)
    assert main(["report", str(in_shards), "--scheduler", "tcp://127.0.0.1:9"]) == 2
    assert "scheduler: expected the address of a running dask scheduler" in capsys.readouterr().err
