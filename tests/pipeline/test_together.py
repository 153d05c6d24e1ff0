"""Members whose systems are set up at once: each has the row that it has alone, to the last bit."""

import contextlib
from dataclasses import fields
from functools import cached_property, partial
from itertools import groupby

import numpy as np
import pytest

from stickslip.pipeline import parse_scene
from stickslip.pipeline.dataset.schema import encode, schema_of
from stickslip.pipeline.ensemble import expand, member
from stickslip.pipeline.running import worker
from stickslip.sim import IntegrationError, System, draw_system
from stickslip.sim.engines.several import kind_of
from stickslip.sim.simulation import as_engine, as_task
from tests.fuzz.relations import setup_of
from tests.scenes import COULOMB, SIGMOID, ensemble
from tests.systems import TERMS

RECORD = "[record]\nevents = true\nend = true\nepisodes = true\n"


def bytes_of(members, found, recording):
    return encode(worker.columns(members, found, recording), schema_of(recording))


def members_of(source):
    scene = parse_scene(source.encode())
    return list(expand.expand(scene)), scene.recording


@pytest.mark.parametrize("perturbation", ["", "[perturbation]\nsizes = [0.05]\nreadings = ['scale', 'relative']\n"])
def test_members_together_have_the_rows_that_they_have_alone(rng, perturbation):
    """Drawn wide: sizes, couplings, damping, friction and belts."""
    for _ in range(2):
        system = (
            f'coupling = "{rng.choice(["antisymmetric", "symmetric", "full", "signed_diagonal"])}"\n'
            f"kappa = {10.0 ** rng.uniform(-2, 0)}\n"
            f"rho = {rng.choice([0.0, 0.5, 3.5, 200.0])}\n"
            f"friction = {rng.uniform(0.1, 2.0)}\n"
            f"belt_speed = {rng.choice([-0.2, 0.3, -1.0])}"
        )
        sizes = rng.choice(np.arange(1, 60), 3, replace=False).tolist()
        scene = ensemble(
            sizes, 10.0, 3, COULOMB, SIGMOID, seed=int(rng.integers(1 << 31)), rest=perturbation + RECORD
        )
        members, recording = members_of(scene.replace('coupling = "antisymmetric"', system))
        together = worker.run_members(members, recording)
        alone = [found for member in members for found in worker.run_members([member], recording)]
        assert bytes_of(members, together, recording) == bytes_of(members, alone, recording)
        order = rng.permutation(len(members))
        mixed = worker.run_members([members[k] for k in order], recording)
        back = [mixed[k] for k in np.argsort(order)]
        assert bytes_of(members, back, recording) == bytes_of(members, alone, recording)


@pytest.mark.parametrize(
    "terms",
    [
        "",
        "mass = 2.0",
        "static = 1.3",
        "static = 1.3\nback_slip = false\nweakening = {law = 'stribeck', speed = 0.5}",
    ],
)
def test_what_systems_of_one_ensemble_share_is_what_each_has_alone(terms):
    members, _ = members_of(ensemble(4, 10.0, 3, COULOMB).replace("n = 4", f"n = 4\n{terms}"))
    systems = [member.system() for member in members]
    assert systems[0].static is systems[1].static
    names = {name for name, value in vars(System).items() if isinstance(value, cached_property) and name[0] != "_"}
    for system in systems:
        anew = system.changed()
        for name in names | {field.name for field in fields(System)}:
            np.testing.assert_equal(getattr(system, name), getattr(anew, name), name)


@pytest.mark.filterwarnings("ignore:.*encountered")
@pytest.mark.parametrize(("start", "words"), [((np.nan, 0.0), "z0: expected"), ((0.0, 1.7e308), "t = 0")])
def test_a_member_that_fails_among_others_fails_alone(monkeypatch, start, words):
    members, recording = members_of(ensemble(5, 10.0, 4, COULOMB, SIGMOID, rest=RECORD))
    undisturbed = worker.run_members(members, recording)
    own = member.Member.start
    failing = members[3]
    monkeypatch.setattr(member.Member, "start", lambda self, end=None: start if self is failing else own(self, end))
    found = worker.run_members(members, recording)
    assert found[3]["outcome"] == "failed"
    assert words in found[3]["reason"]
    rest = [k for k in range(len(members)) if k != 3]
    for one in (undisturbed, found):
        assert all(one[k]["outcome"] != "failed" for k in rest)
    kept = [members[k] for k in rest]
    expected, got = ([one[k] for k in rest] for one in (undisturbed, found))
    assert bytes_of(kept, got, recording) == bytes_of(kept, expected, recording)


@pytest.mark.parametrize(("n", "at_most"), [(5, 128), (50, 26), (300, 1)])
def test_no_more_systems_are_held_than_their_size_allows(monkeypatch, n, at_most):
    members, recording = members_of(ensemble(n, 2.0, 200, COULOMB, rest=RECORD))
    drawn = []
    own = member.Member.system
    monkeypatch.setattr(member.Member, "system", lambda self: drawn.append(self) or own(self))
    next(iter(worker._prepared(members, recording)))
    assert len(drawn) == at_most


@pytest.mark.parametrize("engine", [{"name": "coulomb"}, {"name": "sigmoid", "eps": 0.01, "thresholds": [1.0, 3.0]}])
def test_runs_of_any_length_that_begin_together_are_as_alone(rng, engine):
    """Some end in their first slice, some fill the buffers or take many slices, some collapse or escape."""
    settings = dict(engine)
    chosen = as_engine(settings.pop("name"), settings)
    n, tasks = int(rng.integers(1, 6)), []
    for _ in range(12):
        coupling, rho, belt = (
            rng.choice(["antisymmetric", "full"]),
            rng.choice([0.1, 3.5]),
            rng.choice([-0.2, 0.2, -1]),
        )
        system = draw_system(coupling, n, int(rng.integers(1 << 31)), rho=rho, belt_speed=float(belt))
        start, length = rng.choice([0.0, -3.0, 1e6]), rng.choice([1e-3, 20.0, 2000.0])
        tasks.append(as_task(chosen, system, rng.normal(size=n), rng.normal(size=n), start + length, t_start=start))
    for task, run in zip(tasks, chosen.prepare(tasks), strict=True):
        one, other = run(), chosen.integrate(task)
        assert (one.outcome, one.reason, one.t_end, one.t_collapse, one.stats) == (
            other.outcome, other.reason, other.t_end, other.t_collapse, other.stats,
        )  # fmt: skip
        assert one.z.tobytes() == other.z.tobytes()
        assert one.w.tobytes() == other.w.tobytes()
        assert one.stills.total.tobytes() == other.stills.total.tobytes()
        for name in ("t", "block", "mode", "initial_mode"):
            mine, its = (
                [getattr(series, name).tobytes() for series in (run.events, *run.by_threshold.values())]
                for run in (one, other)
            )
            assert mine == its


def _ended(run):
    """What a run gives, to the byte, or the words with which it fails."""
    try:
        found = run()
    except (ValueError, IntegrationError) as error:
        return str(error)
    events, stills = found.events, found.stills
    arrays = found.z, found.w, events.t, events.block, events.mode, events.initial_mode, stills.t, stills.total
    return found.outcome, found.reason, found.t_end, found.stats, *(array.tobytes() for array in arrays)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("engine", [{"name": "coulomb", "tol": 1e-8}, {"name": "sigmoid", "eps": 0.01}])
def test_systems_of_all_kinds_that_are_prepared_together_are_run_as_alone(engine, random_seed):
    settings = dict(engine)
    chosen = as_engine(settings.pop("name"), settings)
    seed = random_seed
    tasks = []
    for number in range(120):
        terms = TERMS if number % 3 == 0 else ()
        setup = setup_of(seed, number, terms)
        with contextlib.suppress(ValueError):  # what the engine does not take
            tasks.append(as_task(chosen, setup.system, setup.z, setup.w, min(setup.t_end, 8.0)))
    tasks.sort(key=lambda task: (task.system.n, task.system.is_plain))
    assert max(len([*group]) for kind, group in groupby(tasks, kind_of) if kind is not None) > 1
    together = [_ended(run) for run in chosen.prepare(tasks)]
    assert together == [_ended(partial(chosen.integrate, task)) for task in tasks]


def test_a_stack_that_records_more_than_its_buffers_hold_is_run_as_alone(rng):
    """Pairs that both stick every few units of time: 200 runs to t = 300 fill the room for 13,000 events."""
    chosen, system = as_engine("coulomb", {}), draw_system("full", 2, 1264, rho=0.05, kappa=1.0)
    tasks = [as_task(chosen, system, rng.normal(size=2), "belt", 300.0) for _ in range(200)]
    together = [_ended(run) for run in chosen.prepare(tasks)]
    assert sum(len(run[6]) // 8 for run in together) > 13_000
    assert together == [_ended(partial(chosen.integrate, task)) for task in tasks]
