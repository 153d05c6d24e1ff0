"""Lists that span a grid, and distributions over the blocks: which members, which draws, which columns."""

from __future__ import annotations

import itertools
import math
import shutil

import numpy as np
import pandas as pd
import pytest
import scipy.sparse

from stickslip.pipeline import SceneError, expand, parse_scene, query, run_ensemble, verify
from stickslip.pipeline.running import estimate
from stickslip.pipeline.scene.toml import written
from stickslip.sim.systems.weakening import Rational
from stickslip.workflows.reporting import study_of
from tests.scenes import COULOMB, ENDING, ensemble

GRID = """\
[system]
coupling = "antisymmetric"
n = [3, 4]
kappa = [0.2, 0.1]
belt_speed = [-0.1, -0.2]
[start]
z = [-0.7, -0.5]
w = -0.4
[run]
t_end = 5.0
matrices = 2
seed = 3
[[engine]]
name = "coulomb"
tol = 1e-6
[[engine]]
name = "sigmoid"
rtol = 1e-5
atol = 1e-5
ratio = "uniform"
[twins]
sizes = 1e-3
[analysis]
t_burn = 1.0
dt = 0.5
"""

DRAWN = (
    """\
[system]
coupling = "antisymmetric"
n = 3
damping = {uniform = [0.0, 0.5]}
friction = [1.0, {uniform = [0.8, 1.2]}]
[start]
z = {uniform = [-1, 1]}
w = [-0.4, {normal = [0.0, 0.1]}]
draws = 3
[run]
t_end = 5.0
matrices = 2
seed = SEED
"""
    + ENDING
)


def scene_of(text, *edits):
    for old, new in edits:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return parse_scene(text.encode())


@pytest.fixture
def seed(random_seed):
    return random_seed


def drawn(purpose, seed, *key):
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(purpose, *key)))


# ---------------------------------------------------------------------------------------------- the grid


def test_lists_are_a_grid_and_their_values_are_in_the_names():
    scene = scene_of(GRID)
    members = expand(scene)
    assert len({member.member_id for member in members}) == len(members) == scene.n_members == 2 * 2 * 8 * 4
    assert scene.extent == "2 kappa x 2 belt_speed x 2 z x 2 engines"
    assert members[0].member_id == "n3-m000-kappa=0.1-belt_speed=-0.2-z=-0.7-coulomb-1e-6"
    for member in members:
        assert (
            f"-kappa={member.term('kappa'):g}-belt_speed={member.term('belt_speed'):g}-z={member.begin.z0:g}-"
            in member.member_id
        )


def test_members_of_one_matrix_share_their_draws_across_the_grid():
    alike: dict[tuple, list] = {}
    for member in expand(scene_of(GRID)):
        alike.setdefault((member.n, member.source.matrix), []).append(member)
    assert len(alike) == 4
    for members in alike.values():
        by_kappa = {member.term("kappa"): member.system() for member in members}
        assert by_kappa[0.2].stiffness == pytest.approx(2 * by_kappa[0.1].stiffness, rel=1e-14)
        assert np.array_equal(by_kappa[0.2].damping, by_kappa[0.1].damping)
        assert len({member.ratios().tobytes() for member in members if member.engine == "sigmoid"}) == 1
        moves = np.array([np.array(m.start()) - [[m.begin.z0], [m.begin.w0]] for m in members if m.change.twin_size])
        assert moves == pytest.approx(np.broadcast_to(moves[0], moves.shape), abs=1e-15)


def test_one_value_has_a_word_only_in_a_list():
    """A list may grow from one value; ids of scenes without lists stay what they were."""
    plain = scene_of(GRID, ("[0.2, 0.1]", "0.2"), ("[-0.1, -0.2]", "-0.1"), ("[-0.7, -0.5]", "-0.7"))
    one = scene_of(GRID, ("[0.2, 0.1]", "[0.2]"), ("[-0.1, -0.2]", "-0.1"), ("[-0.7, -0.5]", "-0.7"))
    assert expand(plain)[0].member_id == "n3-m000-coulomb-1e-6"
    assert expand(one)[0].member_id == "n3-m000-kappa=0.2-coulomb-1e-6"
    assert plain.extent == ""


def test_the_order_of_a_list_means_nothing():
    one, other = scene_of(GRID), scene_of(GRID, ("kappa = [0.2, 0.1]", "kappa = [0.1, 0.2]"))
    assert one.hash == other.hash
    assert expand(one) == expand(other)
    assert scene_of(GRID, ("kappa = [0.2, 0.1]", "kappa = [0.2, 0.3]")).hash != one.hash


def test_lists_that_are_zipped_go_together():
    zipped = scene_of(GRID, ("seed = 3", 'seed = 3\nzip = [["z", "kappa"]]'))
    pairs = {(member.term("kappa"), member.begin.z0) for member in expand(zipped)}
    assert pairs == {(0.2, -0.7), (0.1, -0.5)}
    assert zipped.n_members == len(expand(zipped)) == 2 * 2 * 4 * 4
    assert zipped.extent == "2 kappa with z x 2 belt_speed x 2 engines"


def test_a_grid_that_grows_or_is_resumed_keeps_its_bytes(content, tmp_path):
    source, out = GRID.encode(), tmp_path / "grown"
    run_ensemble(parse_scene(source), tmp_path / "whole", workers=0)
    small = GRID.replace("kappa = [0.2, 0.1]", "kappa = [0.2]").encode()
    run_ensemble(parse_scene(small), out, workers=0)
    before = content(out / "data")
    run_ensemble(parse_scene(source), out, workers=0)
    assert before.items() <= content(out / "data").items()
    assert verify(out) == []
    tables = (query.members(tmp_path / name).set_index("member_id") for name in ("whole", "grown"))
    # what was numbered before it grew keeps its number
    whole, grown = (table[[name for name in table if not name.startswith("design_")]] for table in tables)
    assert grown.loc[whole.index].equals(whole)
    assert whole.groupby(["kappa", "belt_speed", "z0"]).size().tolist() == [16] * 8

    half = shutil.copytree(tmp_path / "whole", tmp_path / "half")  # resumed, as if it had been killed
    shards = sorted((half / "data").iterdir())
    assert len(shards) > 4
    for shard in shards[1::2]:
        shard.unlink()
    run_ensemble(parse_scene(source), half, workers=0)
    assert content(half / "data") == content(tmp_path / "whole" / "data")


def test_lists_of_an_engine_are_tables_of_it():
    lists = 'name = "sigmoid"\neps = [0.1, 0.03]\nrtol = [1e-5, 1e-4]\natol = 1e-5'
    tables = [f'name = "sigmoid"\neps = {eps}\nrtol = {rtol}\natol = 1e-5' for eps in (0.1, 0.03)
              for rtol in (1e-5, 1e-4)]  # fmt: skip
    one, other = (parse_scene(ensemble(3, 5.0, 2, *engines).encode()) for engines in ([lists], tables))
    assert one.hash == other.hash
    assert expand(one) == expand(other)
    assert one.n_members == 8


def test_seeds_in_a_list_are_runs_of_each(tmp_path):
    several = GRID.replace("seed = 3", "seed = [5, 3]")
    scene = parse_scene(several.encode())
    assert scene.extent.startswith("2 kappa x 2 belt_speed x 2 z x 2 seed")
    assert [one.run.seed for one in (scene, parse_scene(scene.source))] == [(5, 3)] * 2
    alone = {m.member_id: m for m in expand(scene_of(GRID))}
    both = {m.member_id.replace("-seed=3", ""): m for m in expand(scene) if m.source.seed == 3}
    assert both.keys() == alone.keys()
    for name in list(alone)[::7]:
        assert np.array_equal(both[name].system().stiffness, alone[name].system().stiffness)
    zipped = scene_of(several, ("matrices = 2", 'matrices = 2\nzip = [["seed", "kappa"]]'))
    assert {(m.source.seed, m.term("kappa")) for m in expand(zipped)} == {(5, 0.2), (3, 0.1)}


def test_seeds_are_further_matrices_to_the_report(tmp_path):
    run_ensemble(parse_scene(ensemble(4, 5.0, 3, COULOMB, seed=[0, 1]).encode()), tmp_path / "out", workers=0)
    (group,) = study_of(str(tmp_path / "out")).groups
    assert sorted(group.members.matrix) == list(range(6))
    assert group.unit == "matrix"


# ---------------------------------------------------------------------------------------------- distributions


def test_each_draw_is_numpys_own_under_its_key(seed):
    scene = scene_of(DRAWN.replace("SEED", str(seed)))
    assert scene.extent == "2 friction x 2 w x 3 draws of the start"
    members = {member.member_id: member for member in expand(scene)}
    assert len(members) == scene.n_members == 2 * 2 * 2 * 3
    name = "n3-m001-friction=uniform0.8_1.2-w=normal0_0.1-s2-coulomb-1e-6"
    member = members[name]
    assert (
        member.drawn
        == "damping = uniform(0, 0.5); friction = uniform(0.8, 1.2); z = uniform(-1, 1); w = normal(0, 0.1)"
    )
    system, (z, w) = member.system(), member.start()
    assert np.array_equal(system.friction, drawn(4, seed, 3, 1).uniform(0.8, 1.2, 3))
    assert np.array_equal(system.damping, drawn(5, seed, 3, 1).uniform(0.0, 0.5, 3))
    assert np.array_equal(z, drawn(6, seed, 3, 1, 2).uniform(-1, 1, 3))
    assert np.array_equal(w, drawn(7, seed, 3, 1, 2).normal(0.0, 0.1, 3))
    with_rho = scene_of(DRAWN.replace("SEED", str(seed)), ("damping = {uniform = [0.0, 0.5]}", "rho = 2.0"))
    other = {member.member_id: member for member in expand(with_rho)}[name]
    assert np.array_equal(other.system().stiffness, system.stiffness)  # nothing else's draws move
    assert np.array_equal(other.start()[0], z)


def test_twins_of_starts_that_are_drawn_are_moved_each_its_own_way(seed):
    members = expand(scene_of(DRAWN.replace("SEED", str(seed)), ("[run]", "[twins]\nsizes = [1e-3, 1e-5]\n[run]")))
    twins = [member for member in members if member.change.twin_size is not None]
    assert {member.begin.draw for member in twins} == {0, 1, 2}
    for member in twins:
        moved = np.array(member.start()) - np.array(np.broadcast_arrays(*member.base.start(), np.empty(3))[:2])
        by = drawn(3, seed, 3, member.source.matrix, member.begin.draw).standard_normal((2, 3))
        np.testing.assert_allclose(
            moved, by * member.change.twin_size / np.sqrt((by**2).sum() / 3), rtol=0, atol=1e-15
        )


def test_what_is_drawn_is_null_and_said_in_a_text(seed, tmp_path):
    source = DRAWN.replace("SEED", str(seed)).encode()
    run_ensemble(parse_scene(source), tmp_path / "out", workers=0)
    assert verify(tmp_path / "out") == []
    table = query.members(tmp_path / "out")
    assert set(table.outcome) <= {"finished", "collapsed"}
    for column in ("rho", "damping", "z0"):
        assert table[column].isna().all()
    assert sorted(table.friction.dropna().unique()) == [1.0]
    assert (table.drawn.str.contains("friction = uniform(0.8, 1.2)", regex=False) == table.friction.isna()).all()
    assert sorted(table.start_draw.unique()) == [0, 1, 2]
    more = DRAWN.replace("SEED", str(seed)).replace("draws = 3", "draws = 4").encode()
    run_ensemble(parse_scene(more), tmp_path / "out", workers=0)
    grown = query.members(tmp_path / "out")
    assert len(grown) == 4 * len(table) / 3
    assert grown[grown.start_draw < 3].sort_values("member_id").equals(table.sort_values("member_id")) or (
        grown.set_index("member_id").loc[table.member_id].reset_index().equals(table)
    )


def test_static_friction_is_swept_and_drawn(seed, tmp_path):
    keys = "static = [1.2, {uniform = [1.3, 1.5]}]\nfriction = [1.0,"
    scene = scene_of(DRAWN.replace("SEED", str(seed)), ("friction = [1.0,", keys))
    members = expand(scene)
    assert len({member.member_id for member in members}) == len(members) == scene.n_members == 2 * 2 * 2 * 2 * 3
    plain = {member.member_id for member in expand(scene_of(DRAWN.replace("SEED", str(seed))))}
    for member in members:
        system = member.system()
        expected = (
            1.2 if member.term("static") == 1.2 else drawn(9, seed, 3, member.source.matrix).uniform(1.3, 1.5, 3)
        )
        assert np.array_equal(system.static, np.broadcast_to(expected, 3))
        assert member.member_id.replace("-static=1.2", "").replace("-static=uniform1.3_1.5", "") in plain
    run_ensemble(scene, tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out")
    assert sorted(table.static.dropna().unique()) == [1.2]
    assert (table.drawn.str.contains("static = uniform(1.3, 1.5)", regex=False) == table.static.isna()).all()


def test_static_friction_may_be_a_ratio_of_the_kinetic(seed, tmp_path):
    """The factor is drawn as `static` would be, and the friction as it is without."""
    keys = "static = [{ratio = 1.25}, {ratio = {uniform = [1.1, 1.4]}}]\nfriction = [2.0,"
    scene = scene_of(DRAWN.replace("SEED", str(seed)), ("friction = [1.0,", keys))
    members = expand(scene)
    assert len({member.member_id for member in members}) == len(members) == scene.n_members == 2 * 2 * 2 * 2 * 3
    for member in members:
        system, matrix = member.system(), member.source.matrix
        kinetic = (
            np.full(3, 2.0) if "friction=2" in member.member_id else drawn(4, seed, 3, matrix).uniform(0.8, 1.2, 3)
        )
        factor = 1.25 if "static=ratio_1.25" in member.member_id else drawn(9, seed, 3, matrix).uniform(1.1, 1.4, 3)
        assert np.array_equal(system.friction, kinetic)
        assert np.array_equal(system.static, factor * kinetic)
    run_ensemble(scene, tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out")
    assert set(table.outcome) <= {"finished", "collapsed"}
    assert sorted(table.static.dropna().unique()) == [2.5]
    assert (table.static.notna() == (table.friction.notna() & ~table.drawn.str.contains("static"))).all()
    assert table.drawn.str.contains("static = uniform(1.1, 1.4) friction", regex=False).sum() == len(table) // 2
    assert load_again(scene).hash == scene.hash
    for given in (
        "{ratio = 0.9}",
        "{ratio = [1.1, 1.2]}",
        "{ratio = {normal = [1.3, 0.1]}}",
        "{ratio = 1.2, of = 1}",
    ):
        with pytest.raises(
            SceneError, match=r"system\.static: expected a ratio to friction of at least 1, .* write e\.g"
        ):
            scene_of(DRAWN.replace("SEED", "1"), ("n = 3", f"n = 3\nstatic = {given}"))


def test_a_draw_that_is_there_twice_is_shown_as_it_is_written():
    twice = "friction = [{uniform = [0.8, 1.2]}, {uniform = [0.8, 1.2]}, "
    with pytest.raises(
        SceneError, match=r"friction: expected each value once, got \{uniform = \[0\.8, 1\.2\]\} more"
    ):
        scene_of(DRAWN.replace("SEED", "1"), ("friction = [1.0, ", twice))


def test_forces_are_several_and_on_some_blocks(seed, tmp_path):
    """Each of several has draws of its own, and the run is that of the same forces given to `simulate`."""
    forces = (
        "force = [{amplitude = 0.5, frequency = {uniform = [0.9, 1.1]}, blocks = [2, 0]},"
        " {times = [0, 10], values = [0, 2], blocks = 1}, {amplitude = 0.5, frequency = {uniform = [0.9, 1.1]}}]"
    )
    scene = scene_of(DRAWN.replace("SEED", str(seed)), ("n = 3", f"n = 3\n{forces}"))
    assert load_again(scene).hash == scene.hash == scene.from_source.hash
    for member in expand(scene)[:7]:
        first, third = (drawn(13, seed, 3, member.source.matrix, k).uniform(0.9, 1.1, 3) for k in (0, 2))
        t = np.array([0.0, 5.0, 20.0])[:, None]
        expected = 0.5 * np.cos(first * t) * [1, 0, 1] + 0.5 * np.cos(third * t)
        expected[:, 1] += [0.0, 1.0, 2.0]
        np.testing.assert_allclose(member.system().force_at(t[:, 0]), expected, atol=1e-15)
    run_ensemble(scene, tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out")
    assert table[["force_amplitude", "force_frequency", "force_phase"]].isna().all(axis=None)
    assert (table.drawn == [member.drawn for member in expand(scene)]).all()
    assert "0.5 cos(uniform(0.9, 1.1) t + 0) on blocks 0, 2 + (0 at 0 to 2 at 10) on blocks 1" in table.drawn[0]
    one = scene_of(
        DRAWN.replace("SEED", "1"), ("n = 3", "n = 3\nforce = {amplitude = [1, 2], frequency = 1.0, blocks = [0]}")
    )
    amplitudes = {tuple(member.system().force[0].amplitude) for member in expand(one)}
    assert amplitudes == {(1.0, 0.0, 0.0), (2.0, 0.0, 0.0)}
    assert "force_blocks = 0" in expand(one)[0].drawn


ON_BELT = ("w = [-0.4, {normal = [0.0, 0.1]}]", 'w = "belt"')
DRIVEN = """\
static = 1.5
mass = [1.0, {uniform = [0.8, 1.2]}]
belt_speed = {normal = [-0.1, 0.01]}
force = {amplitude = [0.5, 1.0], frequency = {uniform = [0.9, 1.1]}}
weakening = {law = "rational", rate = [2.0, 3.0]}
back_slip = false
"""


def test_what_drives_the_blocks_is_swept_and_drawn(seed):
    text = DRAWN.replace("SEED", f'{seed}\nzip = [["force_amplitude", "weakening_rate"]]')
    scene = scene_of(text, ("friction = [1.0, {uniform = [0.8, 1.2]}]", DRIVEN), ON_BELT)
    assert scene.extent == "2 mass x 2 force_amplitude with weakening_rate x 3 draws of the start"
    members = expand(scene)
    assert len({member.member_id for member in members}) == len(members) == scene.n_members == 2 * 2 * 2 * 3
    for member in members:
        system, key = member.system(), (3, member.source.matrix)
        masses = 1.0 if member.term("mass") == 1.0 else drawn(10, seed, *key).uniform(0.8, 1.2, 3)
        assert np.array_equal(system.mass, np.broadcast_to(masses, 3))
        assert np.array_equal(system.belt_speed, drawn(11, seed, *key).normal(-0.1, 0.01, 3))
        assert np.array_equal(member.start()[1], system.belt_speed)
        (force,) = system.force
        assert (force.amplitude == member.term("force_amplitude")).all()
        assert np.array_equal(force.frequency, drawn(13, seed, *key).uniform(0.9, 1.1, 3))
        assert system.weakening == Rational({0.5: 2.0, 1.0: 3.0}[member.term("force_amplitude")])
        assert not system.back_slip
        assert member.term("back_slip") == "barred"
    assert load_again(scene).hash == scene.hash
    assert scene.changed(system={"back_slip": True}).hash != scene.hash


def test_a_force_may_be_given_by_times_and_values(seed, tmp_path):
    force = "n = 3\nforce = {times = [0, 10, 20], values = [0, 2, -1]}"
    scene = scene_of(DRAWN.replace("SEED", str(seed)), ("n = 3", force))
    harmonic = scene.changed(system={"force": {"amplitude": 1.0, "frequency": 2.0}})
    assert [one.member_id for one in expand(harmonic)] == [one.member_id for one in expand(scene)]
    assert harmonic.hash != load_again(scene).hash == scene.hash
    for member in expand(scene):
        assert member.system().force_at([5.0, 15.0, 30.0]).tolist() == [[1.0] * 3, [0.5] * 3, [-1.0] * 3]
        assert "force = 0 at 0 to 2 at 10 to -1 at 20" in member.drawn
    run_ensemble(scene, tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out")
    assert table[["force_amplitude", "force_frequency", "force_phase"]].isna().all(axis=None)
    assert (table.drawn == [member.drawn for member in expand(scene)]).all()


def load_again(scene):
    return parse_scene(written(scene.model_dump(mode="json", by_alias=True, exclude_none=True)).encode())


def test_a_belt_may_change_its_speed(seed):
    belts = "damping = 0.0\nbelt_speed = {times = [0, 10], values = [-0.1, -0.2]}"
    text = DRAWN.replace("SEED", str(seed))
    scene = scene_of(text, ("damping = {uniform = [0.0, 0.5]}", belts), ON_BELT)
    member = expand(scene)[0]
    assert member.system().belt_speed_at([0.0, 5.0, 20.0])[:, 0].tolist() == pytest.approx([-0.1, -0.15, -0.2])
    assert member.start()[1].tolist() == [-0.1] * 3
    assert "belt_speed = -0.1 at 0 to -0.2 at 10" in member.drawn
    assert load_again(scene).hash == scene.hash


def test_a_number_may_be_the_damping_itself():
    member = expand(scene_of(DRAWN, ("SEED", "1"), ("damping = {uniform = [0.0, 0.5]}", "damping = 0.0")))[0]
    assert (member.term("damping"), member.term("rho"), member.system().damping.tolist()) == (0.0, None, [0.0] * 3)


# ---------------------------------------------------------------------------------------------- graphs


def graph(name, seed, keys=""):
    text = DRAWN.replace("SEED", str(seed)).replace('"antisymmetric"', f'"{name}"\n{keys}')
    return text.replace("friction = [1.0, {uniform = [0.8, 1.2]}]", "").replace("w = [-0.4, {", "w = -0.4 # ")


def test_each_graph_has_its_springs_and_leaves(seed):
    """Symmetric, rows that sum to the leaf springs, and off the diagonal the springs to the neighbours."""
    n = int(np.random.default_rng(seed).integers(5, 12))
    width = math.ceil(math.sqrt(n))
    apart = {
        "chain": lambda i, j: j - i == 1,
        "ring": lambda i, j: j - i in (1, n - 1),
        "grid": lambda i, j: j - i == width or (j - i == 1 and j % width != 0),
    }
    for name, are_tied in apart.items():
        (member, *_) = expand(scene_of(graph(name, seed, "kappa = 2.0\nleaf = 0.25").replace("n = 3", f"n = {n}")))
        stiffness = member.system().stiffness
        assert scipy.sparse.issparse(stiffness)
        dense = stiffness.toarray()
        assert dense.sum(axis=1) == pytest.approx(np.full(n, 0.25))
        for i, j in itertools.combinations(range(n), 2):
            assert dense[i, j] == dense[j, i] == (-2.0 if are_tied(i, j) else 0.0), (name, i, j)


def test_a_network_is_drawn_and_one_of_lower_degree_is_a_part_of_it(seed):
    scene = scene_of(
        graph("network", seed, "kappa = 1.0\ndegree = [2.0, 4.0]\nleaf = {uniform = [0.1, 0.2]}").replace(
            "n = 3", "n = 9"
        )
    )
    systems = {
        (member.source.matrix, member.term("degree")): member.system().stiffness.toarray() for member in expand(scene)
    }
    for matrix in (0, 1):
        few, many = (systems[matrix, degree] - np.diag(np.diag(systems[matrix, degree])) for degree in (2.0, 4.0))
        assert ((few != 0).sum(), (many != 0).sum()) == (2 * 9, 2 * 18)
        assert (many[few != 0] == -1.0).all()
        leaves = systems[matrix, 2.0].sum(axis=1)
        assert leaves == pytest.approx(drawn(8, seed, 9, matrix).uniform(0.1, 0.2, 9), abs=1e-12)
    assert not np.array_equal(systems[0, 4.0], systems[1, 4.0])


def test_a_long_chain_runs_sparse(seed, tmp_path, monkeypatch):
    text = graph("chain", seed, "kappa = 0.5").replace("n = 3", "n = 10000")
    source = (
        text.replace("draws = 3", "").replace("matrices = 2", "matrices = 1").replace("t_end = 5.0", "t_end = 2.0")
    )
    scene = parse_scene(source.encode())
    assert sum(member.cost for member in expand(scene)) < 10.0
    monkeypatch.setattr(estimate, "MEMORY_LIMIT", 4e9)
    estimate.check_memory(scene, workers=2)
    with pytest.raises(SceneError, match=r"record\.growth_rate.*set it to false"):
        estimate.check_memory(parse_scene(f"{source}[record]\ngrowth_rate = true\n".encode()), workers=2)
    run_ensemble(scene, tmp_path / "out", workers=0)
    (row,) = query.members(tmp_path / "out").to_dict(orient="records")
    assert (row["outcome"], row["n"], row["kappa"], row["leaf"]) == ("finished", 10000, 0.5, 0.1)
    assert row["n_events"] > 100
    assert pd.isna(row["degree"])


# ---------------------------------------------------------------------------------------------- what is refused

FORCES = ["system.force", "amplitude and frequency, or times and values"]
BAD = {
    "no values of an engine": ("tol = 1e-6", "tol = []", ["engine[0]", "tol: expected 1 to 1000 values"]),
    "an engine's value twice": ("tol = 1e-6", "tol = [1e-6, 1e-6]", ["engine[0]", "tol: expected each value once"]),
    "a text among tolerances": ("tol = 1e-6", 'tol = [1e-6, "a"]', ["engine[0].tol", "a valid number", "'a'"]),
    "no seeds": ("seed = 3", "seed = []", ["run.seed", "1 to 1000 values"]),
    "a seed twice": ("seed = 3", "seed = [3, 3]", ["run.seed", "each value once"]),
    "a list where none can be": ("t_end = 5.0", "t_end = [5.0, 6.0]", ["run.t_end", "takes no list"]),
    "a list of names": ('coupling = "antisymmetric"', 'coupling = ["full", "springs"]',
        ["system.coupling", "takes no list"]),
    "an empty list": ("kappa = [0.2, 0.1]", "kappa = []", ["system.kappa", "1 to 1000 values, got 0"]),
    "a value twice": ("kappa = [0.2, 0.1]", "kappa = [0.2, 0.20]", ["system.kappa", "0.2 more than once"]),
    "a negative value in a list": ("kappa = [0.2, 0.1]", "kappa = [0.2, -1]",
        ["system.kappa", ">= 0", "got -1 in ["]),
    "text in a list": ("kappa = [0.2, 0.1]", 'kappa = ["0.2"]', ["system.kappa", "without quotes: 0.2"]),
    "nan": ("w = -0.4", "w = nan", ["start.w", "finite", "nan"]),
    "beyond float": ("w = -0.4", "w = 1" + "0" * 400, ["start.w", "finite"]),
    "drawn where nothing is by block": ("kappa = [0.2, 0.1]", "kappa = {uniform = [0, 1]}",
        ["system.kappa", "a list of numbers", "uniform"]),
    "an unknown law": ("w = -0.4", "w = {unifrom = [0, 1]}", ["start.w", "did you mean 'uniform'"]),
    "two laws": ("w = -0.4", "w = {uniform = [0, 1], normal = [0, 1]}",
        ["start.w", "one of the keys uniform, normal"]),
    "three numbers": ("w = -0.4", "w = {uniform = [0, 1, 2]}", ["start.w", "[low, high], two finite numbers"]),
    "no width": ("w = -0.4", "w = {uniform = [1, 1]}", ["start.w", "low < high"]),
    "a negative deviation": ("w = -0.4", "w = {normal = [0, -1]}", ["start.w", "deviation above 0"]),
    "a friction below 0": ("n = [3, 4]", "n = 3\nfriction = {uniform = [-1, 1]}", ["system.friction", "0 <= low"]),
    "a friction without bound": ("n = [3, 4]", "n = 3\nfriction = {normal = [1, 1]}", ["system.friction", "below 0"]),
    "a static friction below the kinetic": ("n = [3, 4]", "n = 3\nstatic = [0.9, 1.3]",
        ["system.static", "at least the kinetic", "got 0.9 with friction = 1.0"]),
    "no mass": ("n = [3, 4]", "n = 3\nmass = 0.0", ["system.mass", "number > 0", "0.0"]),
    "a force without frequency": ("n = [3, 4]", "n = 3\nforce = {amplitude = 1.0}", FORCES),
    "a force of both forms": ("n = [3, 4]", "n = 3\nforce = {amplitude = 1.0, times = [0], values = [1]}", FORCES),
    "a force by times with a phase": ("n = [3, 4]", "n = 3\nforce = {phase = 1.0, times = [0], values = [1]}",
        FORCES),
    "a force that is no table": ("n = [3, 4]", "n = 3\nforce = 1.0", FORCES),
    "a force of too many times": ("n = [3, 4]", "n = 3\nforce = {times = [0, 1], values = [1]}",
        ["system.force", "times that increase and as many values"]),
    "a key that no force has": ("n = [3, 4]", "n = 3\nforce = {time = [0], values = [1]}",
        ["system.force.time", "did you mean 'times'"]),
    "a number of another law": ("n = [3, 4]", 'n = 3\nweakening = {law = "rational", speed = 1.0}',
        ["system.weakening.speed: expected none", 'law = "rational"', 'write law = "stribeck"']),
    "times that stand still": ("belt_speed = [-0.1, -0.2]", "belt_speed = {times = [0, 0], values = [1, 2]}",
        ["system.belt_speed", "times that increase"]),
    "a leaf of an ensemble": ("n = [3, 4]", "n = 3\nleaf = 1.0", ["system.leaf", "none with", "remove it"]),
    "a degree of a chain": ('coupling = "antisymmetric"\nn = [3, 4]\nkappa = [0.2, 0.1]',
        'coupling = "chain"\nn = 3\ndegree = 2.0', ["system.degree", 'coupling = "chain"', "remove it"]),
    "more neighbours than blocks": ('coupling = "antisymmetric"\nn = [3, 4]\nkappa = [0.2, 0.1]',
        'coupling = "network"\nn = [3, 4]', ["system.degree", "n - 1 = 2", "got 4"]),
    "both dampings": ("n = [3, 4]", "n = 3\nrho = 1.0\ndamping = 1.0", ["system.damping", "either", "remove one"]),
    "draws of nothing": ("w = -0.4", "w = -0.4\ndraws = 2", ["start.draws", "distribution", "remove it"]),
    "zip of no list": ("seed = 3", 'zip = [["kappa", "rho"]]', ["run.zip", "lists, got 'rho'"]),
    "zip of one": ("seed = 3", 'zip = [["kappa"]]', ["run.zip", "two keys or more", "['kappa']"]),
    "zip of an unknown key": ("seed = 3", 'zip = [["kapa", "z"]]', ["run.zip", "did you mean 'kappa'"]),
    "no force": ("n = [3, 4]", "n = [3, 4]\nforce = []", ["system.force", "one force or more", "write e.g."]),
    "a sweep of several forces": ("n = [3, 4]",
        "n = [3, 4]\nforce = [{amplitude = 1.0, frequency = 1.0}, {amplitude = [1.0, 2.0], frequency = 1.0}]",
        ["system.force", "got a list for amplitude of force 1"]),
    "a force on no block": ("n = [3, 4]",
        "n = [3, 4]\nforce = [{amplitude = 1.0, frequency = 1.0, blocks = [0, 3]}]",
        ["system.force[0].blocks", "from 0 to 2, got 3"]),
    "zip twice": ("seed = 3", 'zip = [["kappa", "z"], ["z", "belt_speed"]]', ["run.zip", '"z" more than once']),
    "zip of other lengths": ("z = [-0.7, -0.5]\nw = -0.4\n[run]",
        'z = [-0.7, -0.5, 0]\nw = -0.4\n[run]\nzip = [["kappa", "z"]]', ["run.zip", "2 of kappa, 3 of z"]),
    "a grid beyond bounds": (
        "kappa = [0.2, 0.1]",
        f"kappa = {[k / 1000 for k in range(1000)]}\nrho = {[k / 1000 for k in range(1000)]}\n"
        f"static = {[1.5 + k / 10 for k in range(10)]}",
        ["10000000 points", "lists: expected"],
    ),
    "scales of a damping without any": ("[twins]\nsizes = 1e-3",
        "[perturbation]\nsizes = 1e-3\n[system.damping]\nuniform = [0, 1]",
        ["perturbation.readings", "with `damping`", '["relative"]']),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_makes_no_sense_is_refused_in_a_line_that_names_the_key(case):
    old, new, words = BAD[case]
    with pytest.raises(SceneError) as caught:
        scene_of(GRID, (old, new))
    lines = str(caught.value).splitlines()
    assert len(lines) == 1
    assert all(word in lines[0] for word in words), lines[0]
    print(lines[0])


def test_a_law_that_falls_from_static_friction_needs_one(seed):
    text = DRAWN.replace("SEED", str(seed))
    law = 'damping = 0.0\nweakening = {law = "stribeck", speed = 0.5}'
    with pytest.raises(ValueError, match="static: expected with the law of Stribeck"):
        scene_of(text, ("damping = {uniform = [0.0, 0.5]}", law))
    scene_of(text, ("damping = {uniform = [0.0, 0.5]}", law + "\nstatic = 1.3"))
