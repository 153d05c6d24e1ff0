"""Members: names that stay, seeds that pair, batches that do not depend on who computes them."""

from __future__ import annotations

import itertools
import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stickslip.pipeline import expand, load_scene, parse_scene
from stickslip.pipeline.ensemble.member import MATRIX, PERTURBATION, RATIO, START_W, START_Z, TWIN
from stickslip.pipeline.ensemble.pack import Batch, tasks
from stickslip.sim.systems.terms import TERMS
from tests.processes import python
from tests.scenes import COULOMB, ensemble

ROOT = Path(__file__).parents[2]
SCENES = ["basin", "burridge_knopoff_slow", "cascades", "counting", "robustness", "survival", "thousands"]


def by_id(scene):
    return {member.member_id: member for member in expand(scene)}


def change(source, **replacements):
    text = source.decode()
    for old, new in replacements.values():
        assert old in text
        text = text.replace(old, new)
    return parse_scene(text.encode())


def test_ids_are_unique_and_in_order(scene):
    members = expand(scene)
    assert len({member.member_id for member in members}) == len(members)
    keys = [(m.n, m.source.matrix, m.change.size, m.change.draw or 0, m.engine, m.ratio_draw or 0) for m in members]
    assert keys == sorted(keys)  # here the engines stand in alphabetical order
    assert members[0].member_id == "n3-m000-coulomb-1e-10"
    assert members[5].member_id == "n3-m000-p0.01-d0-sigmoid-0.03-u1-1e-8-1e-8-c1"


def test_growing_a_scene_renames_nobody_and_changes_nothing(scene, source):
    grown = change(
        source,
        n=("[5, 3]", "[5, 4, 3]"),
        matrices=("matrices = 3", "matrices = 5"),
        sizes=("[0.05, 0.01]", "[0.05, 0.02, 0.01]\ndraws = 2"),
        engine=('[[engine]]\nname = "coulomb"', '[[engine]]\nname = "sigmoid"\n[[engine]]\nname = "coulomb"'),
        ratios=("ratio_draws = 2", "ratio_draws = 4"),
    )
    before, after = by_id(scene), by_id(grown)
    assert len(after) > len(before)
    assert before == {name: after[name] for name in before}


@pytest.mark.parametrize(("old", "new"), [
    ('name = "coulomb"', 'name = "coulomb"\ntol = 1e-9'),
    ("sizes = [0.05, 0.01]", "sizes = [0.05000001, 0.01]"),
    ('stick = "threshold"', 'stick = "threshold"\nthreshold = 1.5'),
    ('stick = "threshold"', 'stick = "manifold"'),
    ('ratio = "uniform"', 'rtol = 1e-7\nratio = "uniform"'),
])  # fmt: skip
def test_another_setting_is_another_name(scene, source, old, new):
    other = change(source, it=(old, new))
    assert set(by_id(other)) != set(by_id(scene))


def test_same_matrix_under_every_engine_and_stiffness(scene):
    systems: dict[tuple, list] = {}
    for member in expand(scene):
        if member.change.draw is None:
            systems.setdefault((member.n, member.source.matrix), []).append(member.system())
    assert len(systems) == 6
    for same in systems.values():
        assert len(same) == 3
        for system in same[1:]:
            assert np.array_equal(system.stiffness, same[0].stiffness)
            assert np.array_equal(system.damping, same[0].damping)
    drawn = [same[0].stiffness.tobytes() for same in systems.values()]
    assert len(set(drawn)) == len(drawn)


def test_stiffness_ratios_are_paired_and_never_zero(scene):
    draws: dict[tuple, list] = {}
    for member in expand(scene):
        if member.engine == "sigmoid":
            draws.setdefault((member.n, member.source.matrix, member.ratio_draw), []).append(member.ratios())
    assert len(draws) == 12
    for same in draws.values():
        assert all(np.array_equal(ratios, same[0]) for ratios in same)
        assert (same[0] > 0).all()
        assert (same[0] <= 1).all()
    assert len({same[0].tobytes() for same in draws.values()}) == 12


def test_no_two_draws_share_their_numbers(scene):
    """Whatever a draw is for: its n, its matrix and its own number count."""
    systems = {(m.n, m.source.matrix): m.system().damping[0] for m in expand(scene) if m.change.draw is None}
    ratios = {(m.n, m.source.matrix, m.ratio_draw): m.ratios()[0] for m in expand(scene) if m.ratio_draw is not None}
    shares = [value / 3.5 - 1 for value in systems.values()] + [1 - value for value in ratios.values()]
    assert len(np.unique(np.round(shares, 12))) == len(shares) == 18


def test_no_two_quantities_share_their_draws():
    fixed = (MATRIX, PERTURBATION, RATIO, TWIN, START_Z, START_W)
    purposes = [*fixed, *(term.purpose for term in TERMS if term.purpose is not None)]
    assert len({*purposes}) == len(purposes)


def drawn(purpose, seed, *key):
    """The generator of a draw, by the documented key: purpose, n, matrix, and which draw of that purpose."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(purpose, *key)))


def test_each_draw_is_numpys_own_under_its_key(source, random_seed):
    """Not frozen from here: numpy draws them anew, so that another key, order or purpose shows."""
    seed = random_seed
    kappa, rho, size = 0.2, 3.5, 0.05
    scene = change(
        source,
        seed=("seed = 7", f"seed = {seed}"),
        draws=("sizes = [0.05, 0.01]", "sizes = [0.05, 0.01]\ndraws = 2\n[twins]\nsizes = [1e-3]"),
    )
    members = by_id(scene)
    n, matrix = 5, 2  # not the same, for a key has both
    own = members["n5-m002-coulomb-1e-10"].system()
    rng = drawn(0, seed, n, matrix)
    damping, u = rng.uniform(rho, 2 * rho, n), rng.uniform(-kappa, kappa, (n, n))
    stiffness = (u - u.T) / 2 + np.diag(np.abs(np.diag(u)))
    assert np.array_equal(own.damping, damping)
    assert np.array_equal(own.stiffness, stiffness)

    moved = members["n5-m002-p0.05-d1-coulomb-1e-10"].system()
    rng = drawn(1, seed, n, matrix, 1)
    dr, du = rng.uniform(-size * rho, size * rho, n), rng.uniform(-size * kappa, size * kappa, (n, n))
    assert np.array_equal(moved.damping, damping + dr)
    assert np.array_equal(moved.stiffness, stiffness + (du - du.T) / 2 + np.diag(np.diag(du)))

    ratios = members["n5-m002-sigmoid-0.03-u1-1e-8-1e-8-c1"].ratios()
    assert np.array_equal(ratios, 1.0 - drawn(2, seed, n, matrix, 1).random(n))

    z, w = members["n5-m002-t0.001-coulomb-1e-10"].start()
    by = drawn(3, seed, n, matrix).standard_normal((2, n))
    by *= 1e-3 / np.sqrt((by**2).sum() / n)
    assert z == pytest.approx(-0.7 + by[0], rel=1e-14)
    assert w == pytest.approx(-0.4 + by[1], rel=1e-14)


#: What a member is, from the file of the scene on, and what of its run becomes which column.
DETERMINING = (
    "dataset/schema", "ensemble/expand", "ensemble/member", "ensemble/new", "own/function", "records/events",
    "records/new", "running/ends", "running/worker", "scene/grid", "scene/new", "scene/quantity", "scene/scene",
    "scene/systems", "scene/toml",
)  # fmt: skip


#: What explains, draws, stores or reads.
OUTSIDE = (
    "sim/runs/show.py", "pipeline/dataset/status.py",
    "pipeline/dataset/verify.py", "pipeline/places/place.py", "pipeline/query/frames.py",
    "pipeline/running/driver.py",
)  # fmt: skip


def test_the_programs_digest_is_of_all_code_that_determines_numbers(tmp_path):
    """Data of two sets of draws are never mixed: a change of any of these sources is another program."""
    shutil.copytree(ROOT / "stickslip", tmp_path / "stickslip", symlinks=True)
    for folder in ("sim", "pipeline"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))

    changes = [
        *OUTSIDE,
        "sim/engines/course.py",
        "sim/new/deeper.py",
        *(f"pipeline/{name}.py" for name in DETERMINING),
    ]
    asked = """
import json, sys
from dataclasses import replace
from pathlib import Path
from stickslip.pipeline.dataset.program import program, version_of
print(program())
for name in json.loads(sys.argv[1]):
    file = Path(name)
    file.parent.mkdir(exist_ok=True)
    source = file.read_text() if file.exists() else ""
    file.write_text(source + "\\nCHANGED = 1\\n")
    version_of.cache_clear()
    print(program())
"""
    found = python("-c", asked, json.dumps(changes), cwd=tmp_path, check=True, timeout=500)
    programs = found.stdout.split()
    assert len(programs) == len(changes) + 1
    is_new = [one != other for one, other in itertools.pairwise(programs)]
    assert is_new == [change not in OUTSIDE for change in changes]


def test_settings_reach_the_engine(source):
    scene = change(source, it=('ratio = "uniform"', 'rtol = 1e-7\natol = 1e-9\nratio = "uniform"'))
    members = by_id(scene)

    def asked(name):
        member = members[name]
        engine, task = member.task(member.system(), member.start())
        return task, {"engine": engine.name} | {key: getattr(engine, key) for key in engine.settings()}

    task, settings = asked("n3-m000-coulomb-1e-10")
    assert (task.z0.tolist(), task.w0.tolist()) == ([-0.7] * 3, [-0.4] * 3)
    assert (task.t_start, task.t_end, len(task.samples)) == (0.0, 8.0, 0)
    assert settings == {"engine": "coulomb", "tol": 1e-10}
    task, settings = asked("n5-m002-sigmoid-0.03-u1-1e-7-1e-9-c1")
    assert task.system.n == 5
    assert settings.pop("ratio").shape == (5,)
    assert settings == {
        "engine": "sigmoid",
        "thresholds": (),
        "eps": 0.03,
        "rtol": 1e-7,
        "atol": 1e-9,
        "stick": "threshold",
        "threshold": 1.0,
    }


def test_batches_hold_every_member_once_in_order(scene):
    members = expand(scene)
    packed = tasks(scene)
    assert len(packed) > 5
    assert [member for batch in packed for member in batch.members] == list(members)
    assert sorted({batch.name for batch in packed}) == [batch.name for batch in packed]
    another = Batch(0, packed[0].members, replace(packed[0].recording, scene_hash="another"))
    assert (another.members, another.name != packed[0].name) == (packed[0].members, True)


def test_members_are_the_same_however_they_are_reached(scene):
    """One by one, by slices, by places, through another process; their ids and costs with and without them."""
    members, made = expand(scene), list(expand(scene))
    assert scene.n_members == len(members) == len(made)
    assert list(members.ids()) == [member.member_id for member in made]
    assert list(members.costs()) == [member.cost for member in made]
    assert [members[k] for k in range(-len(made), 0)] == made
    assert list(members[7:40:3]) == list(members.at(range(7, 40, 3))) == made[7:40:3]
    sent = pickle.loads(pickle.dumps(members[5:20]))
    assert sent == members[5:20]
    assert (list(sent.ids()), list(sent.costs())) == ([*members[5:20].ids()], [*members[5:20].costs()])
    kinds = {(member.source.origin, member.engine) for member in made}
    assert len(members.firsts()) == len(sent.firsts() + members[20:].firsts()) / 2 == len(kinds)
    with pytest.raises(IndexError):
        members[len(made)]


@pytest.mark.parametrize("shipped", SCENES)
def test_any_members_of_a_shipped_scene_are_the_same_in_another_process(shipped, rng):
    members = expand(load_scene(ROOT / "workflows" / "scenes" / f"{shipped}.toml"))
    for k in (0, len(members) - 1, *rng.integers(0, len(members), 3).tolist()):
        for some in (members[k : k + 50], members.at(rng.integers(0, len(members), 10).tolist())):
            sent = pickle.loads(pickle.dumps(some))
            assert list(sent) == list(some)
            assert (list(sent.ids()), list(sent.costs())) == (list(some.ids()), list(some.costs()))


@pytest.mark.parametrize(("matrices", "draws", "most"), [(10_000, 1, 3_000), (1, 10_000, 600_000)])
def test_what_is_sent_of_many_members_is_what_they_differ_in(matrices, draws, most):
    """Of matrices nothing, of starts their numbers and words; whole members would take 79 bytes or more each."""
    source = ensemble(5, 20.0, matrices, COULOMB).replace("z = -0.7", f"z = {{uniform = [0, 1]}}\ndraws = {draws}")
    assert len(pickle.dumps(expand(parse_scene(source.encode())))) < most


def test_members_that_are_run_the_same_way_are_found_together(scene, rng):
    """In any range, and of any places, each once; those of a part have one number of blocks, engine and cost."""
    members = expand(scene)
    for _ in range(20):
        first, last = sorted(rng.integers(0, len(members) + 1, 2).tolist())
        for some in (members[first:last], members.at(rng.permutation(len(members))[: last - first].tolist())):
            parts = [*some.by_variant()]
            assert sorted(name for part in parts for name in part.ids()) == sorted(some.ids())
            for part in parts:
                assert len({(one.n, one.method, one.change, one.cost) for one in part}) == 1
            assert len(parts) == len({(one.n, one.method, one.change) for one in some})


def test_a_scene_of_many_batches_has_larger_ones_and_the_last_are_smaller(scene, monkeypatch):
    members = expand(scene)
    whole = sum(member.cost for member in members)
    monkeypatch.setattr("stickslip.pipeline.ensemble.pack._MANY", 3)
    for parts, of_largest in ((1, 1), (3.01, 3), (6, 3), (24, 4.8)):
        target, largest = whole / parts, whole / of_largest
        monkeypatch.setattr("stickslip.pipeline.ensemble.pack.TARGET_COST", target)
        packed = tasks(scene)
        rest = whole
        for batch in packed:
            room = min(largest, max(rest / 4, largest / 4))
            assert batch.cost <= room * (1 + 1e-9) or len(batch.members) == 1
            rest -= batch.cost
            assert batch is packed[-1] or batch.cost + max(member.cost for member in members) > room
        assert [member for batch in packed for member in batch.members] == list(members)
