"""What a scene may keep beside n_stick, of changed runs and of unchanged ones."""

import math

import numpy as np
import pytest

from stickslip.pipeline import SceneError, StoreError, expand, parse_scene, run_ensemble, verify
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.query import all_events, by_threshold, events, members, separations, series
from stickslip.pipeline.running import worker
from tests.scenes import COULOMB, SIGMOID, ensemble

SOURCE = ensemble(
    4,
    11.0,
    2,
    COULOMB,
    f'{SIGMOID}\nratio = "uniform"\nthresholds = [2.0, 0.5]',
    seed=5,
    rest="""
[perturbation]
sizes = [0.01, 0.05]
readings = ["relative", "scale"]
[twins]
sizes = [1e-6, 1e-3]
[record]
events = true
separation = 2.5
""",
).encode()


@pytest.fixture(scope="module")
def scene():
    return parse_scene(SOURCE)


@pytest.fixture(scope="module")
def kept(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "out"
    run_ensemble(scene, path, workers=0)
    return path


def test_every_change_is_a_member_once(scene):
    found = expand(scene)
    assert len(found) == scene.n_members == 2 * (1 + 4 + 2) * 2
    assert len({member.member_id for member in found}) == len(found)
    names = [member.member_id.split("-")[2] for member in found[:14:2]]
    assert names == ["coulomb", "r0.01", "r0.05", "p0.01", "p0.05", "t1e", "t0.001"]


def test_an_engine_may_leave_changes_out():
    text = SOURCE.replace(b'name = "coulomb"', b'name = "coulomb"\nreadings = []').replace(
        b'name = "sigmoid"', b'name = "sigmoid"\ntwins = false\nreadings = "scale"'
    )
    scene = parse_scene(text)
    found = expand(scene)
    assert len(found) == scene.n_members == 2 * ((1 + 2) + (1 + 2))
    assert {m.engine for m in found if m.change.twin_size is not None} == {"coulomb"}
    assert {(m.engine, m.change.reading) for m in found if m.change.reading} == {("sigmoid", "scale")}


def test_the_base_undoes_one_change(scene):
    by_name = {member.member_id: member for member in expand(scene)}
    plain = by_name["n4-m000-coulomb-1e-10"]
    assert plain.base is None
    for name in ("n4-m000-r0.05-d0-coulomb-1e-10", "n4-m000-t1e-6-coulomb-1e-10"):
        base = by_name[name].base
        assert base.start() == plain.start()
        np.testing.assert_array_equal(base.system().stiffness, plain.system().stiffness)
    drawn = by_name["n4-m000-sigmoid-0.03-u0-1e-8-1e-8"].base
    assert (drawn.ratios(), drawn.base) == (1.0, None)
    both = by_name["n4-m000-t1e-6-sigmoid-0.03-u0-1e-8-1e-8"]
    np.testing.assert_array_equal(both.base.ratios(), both.ratios())


def test_the_separation_is_that_of_two_runs(scene, kept):
    found = dict(separations(kept))
    changed = [member for member in expand(scene) if member.base is not None]
    assert list(found) == [member.member_id for member in changed]
    for member in changed:
        t, distance = found[member.member_id]
        np.testing.assert_array_equal(t, 2.5 * np.arange(5))
        one, other = member.simulate(t).samples, member.base.simulate(t).samples
        assert len(one) == len(other) == 5
        for k in range(5):
            gaps = np.concatenate([one.z[k] - other.z[k], one.w[k] - other.w[k]])
            assert distance[k] == pytest.approx(np.linalg.norm(gaps) / 2.0, rel=1e-12)  # sqrt(n) = 2
    assert found["n4-m000-t0.001-coulomb-1e-10"][1][0] == pytest.approx(1e-3, rel=1e-9)
    assert found["n4-m000-p0.05-d0-coulomb-1e-10"][1][0] == 0.0


def test_the_last_time_is_not_lost_by_rounding(tmp_path):
    """0.3 / 0.1 < 3 in floating point, and 3 * 0.1 > 0.3."""
    text = SOURCE.replace(b"t_end = 11.0", b"t_end = 0.3").replace(b"separation = 2.5", b"separation = 0.1")
    text = text.replace(b"t_burn = 1.0", b"t_burn = 0.0")
    run_ensemble(parse_scene(text), tmp_path / "out", workers=0)
    assert {len(distance) for _, distance in separations(tmp_path / "out").values()} == {4}


def test_a_run_that_ends_early_is_kept_up_to_there(tmp_path):
    """Blocks with little damping and stiff springs run away, a copy earlier than the other or later."""
    text = ensemble(4, 30.0, 3, COULOMB, SIGMOID, rest="[twins]\nsizes = [0.1]\n[record]\nseparation = 0.02")
    scene = parse_scene(text.replace("n = 4", "n = 4\nkappa = [0.5, 5.0]\nrho = [0.1, 3.5]").encode())
    run_ensemble(scene, tmp_path / "out", workers=0)
    rows, distances = members(tmp_path / "out").set_index("member_id"), separations(tmp_path / "out")
    assert set(rows.outcome) == {"finished", "collapsed", "diverged"}
    firsts = set()
    for member in expand(scene):
        row, run = rows.loc[member.member_id], member.simulate()
        ended = {"finished": 30.0, "collapsed": run.t_collapse, "diverged": run.t_end}
        assert row.t_stop == ended[run.outcome]
        assert (row.n_steps, row.n_rejected, row.n_products) == (
            run.stats.n_steps, run.stats.n_rejected, run.stats.n_products,
        )  # fmt: skip
        if member.base is not None:
            reached = [one.t_end for one in (run, member.base.simulate())]
            assert len(distances[member.member_id][1]) == math.floor(min(reached) / 0.02) + 1
            firsts.add(np.sign(reached[0] - reached[1]))
    assert firsts == {-1.0, 0.0, 1.0}


def test_a_scene_that_grows_keeps_its_step(kept):
    text = SOURCE.replace(b"matrices = 2", b"matrices = 3").replace(b"separation = 2.5", b"separation = 5.0")
    with pytest.raises(StoreError, match=r"record\.separation: 5\.0 here, 2\.5 there"):
        run_ensemble(parse_scene(text), kept, workers=0)


def test_an_unchanged_run_is_made_once_for_all_its_copies(scene, monkeypatch):
    """Three runs a matrix for comparison, of coulomb and of the sigmoid with its ratios and with none."""
    worker._states.cache_clear()
    task, made = Member.task, []
    monkeypatch.setattr(
        "stickslip.pipeline.ensemble.member.Member.task", lambda *args: made.append(args) or task(*args)
    )
    for member in expand(scene):
        worker.row(member, scene.recording)
    assert len(made) == scene.n_members + 2 * 3


def test_thresholds_are_those_of_the_sigmoid_runs(scene, kept):
    found = dict(by_threshold(kept))
    sigmoid = [member for member in expand(scene) if member.engine == "sigmoid"]
    assert list(found) == [member.member_id for member in sigmoid]
    assert all(set(by) == {0.5, 2.0} for by in found.values())
    member = sigmoid[3]
    for c, run_series in member.simulate().by_threshold.items():
        for one, other in zip(found[member.member_id][c], run_series.change_points(), strict=True):
            np.testing.assert_array_equal(one, other)


def test_all_events_are_those_of_each(kept):
    found = dict(all_events(kept))
    assert list(found) == list(series(kept))
    for member_id, one in list(found.items())[:3]:
        other = events(kept, member_id)
        for mine, its in zip(one, (other.t, other.block, other.mode, other.initial_mode), strict=True):
            np.testing.assert_array_equal(mine, its)


def test_the_members_table_names_the_change(kept):
    frame = members(kept).set_index("member_id")
    row = frame.loc["n4-m001-r0.05-d0-coulomb-1e-10"]
    assert (row["perturbation_reading"], row["perturbation_size"]) == ("relative", 0.05)
    assert frame["twin_size"].notna().sum() == 8
    assert verify(kept) == []


def test_what_is_not_asked_for_is_not_there(tmp_path):
    text = SOURCE.decode().replace("events = true\nseparation = 2.5", "").replace("thresholds = [2.0, 0.5]", "")
    scene = parse_scene(text.encode())
    run_ensemble(scene, tmp_path / "out", workers=0)
    assert [list(read(tmp_path / "out")) for read in (all_events, separations, by_threshold)] == [[], [], []]


def test_separation_needs_a_change():
    text = SOURCE.decode().replace('ratio = "uniform"', 'ratio = "one"')
    start, end = text.index("[perturbation]"), text.index("[record]")
    with pytest.raises(SceneError, match=r"record.separation: expected a scene with changed runs.*\[twins\]"):
        parse_scene((text[:start] + text[end:]).encode())


def test_the_growth_rate_is_that_of_the_member_s_own_system(tmp_path):
    text = SOURCE.replace(b"events = true", b"growth_rate = true")
    run_ensemble(parse_scene(text), tmp_path / "out", workers=0)
    rates = members(tmp_path / "out").set_index("member_id")["growth_rate"]
    for member in expand(parse_scene(text))[::3]:
        system = member.system()
        # lambda^2 + R lambda + K as the quadratic problem of one matrix polynomial, by its own linearisation
        blocks = np.block([[-np.diag(system.damping), -system.stiffness], [np.eye(4), np.zeros((4, 4))]])
        assert rates[member.member_id] == pytest.approx(np.linalg.eigvals(blocks).real.max(), rel=1e-9)


def test_the_growth_rate_has_the_slope_of_friction_at_the_speed_of_the_belt(tmp_path):
    scene = ensemble(
        1,
        20.0,
        1,
        COULOMB,
        system='coupling = "chain"\nleaf = 1.0\ndamping = 0.1\nfriction = 0.5\nstatic = 1.0\n'
        'weakening = {law = "stribeck", speed = 0.5}\nbelt_speed = [0.8, 1.6]',
        start="z = 0.0\nw = 0.0",
        rest="[record]\ngrowth_rate = true",
        analysis="t_burn = 5.0\ndt = [0.5]",
    )
    run_ensemble(parse_scene(scene.encode()), tmp_path / "out", workers=0)
    found = members(tmp_path / "out").set_index("belt_speed")["growth_rate"]
    for v in (0.8, 1.6):
        drag = 0.1 - (1.0 - 0.5) / 0.5 * np.exp(-v / 0.5)  # mu(v) = 0.5 + 0.5 exp(-v / 0.5)
        assert found[v] == pytest.approx(-drag / 2, rel=1e-12)  # of l^2 + drag l + 1 = 0, which is complex
    moving = scene.replace("belt_speed = [0.8, 1.6]", "belt_speed = {times = [0.0, 5.0], values = [0.8, 1.6]}")
    assert (
        worker.row(expand(parse_scene(moving.encode()))[0], parse_scene(moving.encode()).recording)["growth_rate"]
        is None
    )


def test_a_proof_of_collapse_is_sought_for_every_run_that_asks_for_it():
    source = ensemble(10, 200.0, 4, COULOMB, seed=5)
    asked = parse_scene(f"{source}\n[record]\ncollapse = true\n".encode())
    plain = parse_scene(source.encode())
    certain = 0
    for member, other in zip(expand(asked), expand(plain), strict=True):
        row, bare = worker.row(member, asked.recording), worker.row(other, plain.recording)
        assert row["t_collapse"] == (row["t_stop"] if row["outcome"] == "collapsed" else None)
        assert (bare["outcome"], bare["t_stop"]) == ("finished", 200.0)
        np.testing.assert_array_equal(bare["t"], row["t"])
        np.testing.assert_array_equal(bare["n_stick"], row["n_stick"])
        certain += row["outcome"] == "collapsed"
    assert certain > 0
