"""Starts that are no numbers: on the belt, and where another dataset's members ended."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from stickslip.pipeline import SceneError, StoreError, expand, load_scene, parse_scene, query, run_ensemble
from stickslip.pipeline.running import ends
from stickslip.pipeline.running.ends import end_of
from stickslip.workflows.commands import main
from tests.scenes import COULOMB, ensemble

START = "[start]\nz = -0.7\nw = -0.4"
SIGMOID = 'name = "sigmoid"\neps = [0.1, 0.03]'


def scene(start=START, **words):
    text = ensemble([4, 6], 12.0, 2, f"{COULOMB}\ntol = 1e-8", **words)
    assert text.count(START) == 1
    return text.replace(START, start)


def at_rest(text):
    """`start = "rest"` stands before the first table."""
    return 'start = "rest"\n' + text.replace(START, "")


def test_rest_is_unstretched_springs_on_the_belt():
    text = ensemble(5, 10.0, 2, COULOMB).replace("n = 5", "n = 5\nrho = 1.0\nbelt_speed = [-0.1, -0.2]")
    found = parse_scene(at_rest(text).encode())
    for member in expand(found):
        z, w = member.start(end_of(member))
        assert (z, w) == (0.0, member.term("belt_speed"))
        assert (member.begin.z0, member.begin.w0) == (0.0, member.term("belt_speed"))
        run = member.simulate()
        assert (run.events.initial_mode == 0).all()  # |R v| < mu
    assert found.hash == parse_scene(text.replace(START, '[start]\nz = 0.0\nw = "belt"').encode()).hash
    assert parse_scene(found.source).records == ()
    with pytest.raises(
        SceneError, match=r"start: expected \"rest\" or a table, got 'belt'; write `start = \"rest\"`"
    ):
        parse_scene(at_rest(text).replace('"rest"', '"belt"').encode())


def test_blocks_that_are_drawn_may_all_ride_on_the_belt():
    text = scene('[start]\nz = {uniform = [-0.1, 0.1]}\nw = "belt"\ndraws = 3')
    for member in expand(parse_scene(text.encode())):
        z, w = member.start(end_of(member))
        assert len(set(z)) == member.n
        assert w == member.term("belt_speed")


@pytest.fixture
def first(tmp_path):
    """A dataset with the ends of its runs, and the folder that it is in."""
    (tmp_path / "first.toml").write_text(scene(rest="[record]\nend = true"))
    run_ensemble(load_scene(tmp_path / "first.toml"), tmp_path / "runs" / "first", workers=0)
    return tmp_path


GOES_ON = '[start]\ndataset = "runs/first"'


def test_the_state_at_the_end_is_that_of_simulate(first):
    rows = query.table(first / "runs" / "first").to_pylist()
    members = {member.member_id: member for member in expand(load_scene(first / "first.toml"))}
    for row in rows:
        run = members[row["member_id"]].simulate()
        assert row["z_end"] == run.z.tolist()
        assert row["w_end"] == run.w.tolist()
        last = run.events.initial_mode.copy()
        for block, mode in zip(run.events.block, run.events.mode, strict=True):
            last[block] = mode
        assert (np.array(row["mode_end"]) == 0).tolist() == (last == 0).tolist()
        if row["outcome"] == "finished":
            assert row["mode_end"] == last.tolist()


def test_what_slips_at_the_end_does_so_to_a_side_of_the_belt_as_it_then_goes(tmp_path):
    text = scene(rest="[record]\nend = true").replace(
        "[start]", "belt_speed = {times = [0, 12], values = [-1, 1]}\n[start]"
    )
    run_ensemble(parse_scene(text.encode()), tmp_path / "out", workers=0)
    slips = 0
    for row in query.table(tmp_path / "out").to_pylist():
        w, mode = np.array(row["w_end"]), np.array(row["mode_end"])
        assert row["outcome"] == "finished"
        assert (np.sign(w - 1.0)[mode != 0] == mode[mode != 0]).all()
        slips += np.count_nonzero((mode != 0) & (np.abs(w) < 1.0))  # between the belt's first speed and its last
    assert slips > 0


def test_a_run_goes_on_where_another_ended(first, content):
    """Two halves are one run, with its modes; on workers too, and the state is found by who moved both."""
    (first / "next.toml").write_text(scene(GOES_ON))
    (first / "whole.toml").write_text(scene().replace("t_end = 12.0", "t_end = 24.0"))
    following, whole = (expand(load_scene(first / name)) for name in ("next.toml", "whole.toml"))
    n_events = 0
    for one, both in zip(following, whole, strict=True):
        assert one.member_id.startswith(f"n{one.n}-m{one.source.matrix:03d}-e")
        second, run = one.simulate(end=end_of(one)), both.simulate()
        at = run.events.t >= 12.0
        n_events += at.sum()
        assert second.events.block.tolist() == run.events.block[at].tolist()
        assert second.events.mode.tolist() == run.events.mode[at].tolist()
        np.testing.assert_allclose(second.events.t + 12.0, run.events.t[at], atol=1e-5)
        np.testing.assert_allclose(second.z, run.z, atol=1e-5)
    assert n_events > 0
    for workers in (0, 2):
        run_ensemble(load_scene(first / "next.toml"), first / "runs" / f"next{workers}", workers=workers)
    assert content(first / "runs" / "next0") == content(first / "runs" / "next2")
    table = query.members(first / "runs" / "next0")
    assert set(table.drawn) == {"z = end; w = end"}
    assert table.z0.isna().all()
    assert str(first) not in (first / "runs" / "next0" / "scene.toml").read_text()
    moved = shutil.move(first, first.with_name(f"{first.name}-moved"))
    assert run_ensemble(load_scene(moved / "next.toml"), moved / "runs" / "next0", workers=0).is_complete
    one = expand(load_scene(moved / "runs" / "next0" / "scene.toml"))[0]  # whose copy lies deeper
    assert np.array_equal(*(member.start(end_of(member))[0] for member in (one, following[0])))


def test_the_end_of_one_run_starts_many(first):
    text = scene(GOES_ON).replace("n = [4, 6]", "n = 4\nbelt_speed = [-0.1, -0.2]")
    text = text.replace(COULOMB, SIGMOID).replace("tol = 1e-8\n", "")
    (first / "next.toml").write_text(text)
    members = expand(load_scene(first / "next.toml"))
    assert len(members) == 2 * 2 * 2
    for member in members:
        (old,) = (
            m for m in expand(load_scene(first / "first.toml")) if (m.n, m.source.matrix) == (4, member.source.matrix)
        )
        assert np.array_equal(member.start(end_of(member))[0], query.ends(first / "runs" / "first")[old.member_id][0])


def test_starts_that_were_drawn_are_matched_by_their_draws(tmp_path):
    drawn = "[start]\nz = {uniform = [-1, 1]}\nw = -0.4\ndraws = 3"
    (tmp_path / "first.toml").write_text(scene(drawn, rest="[record]\nend = true"))
    run_ensemble(load_scene(tmp_path / "first.toml"), tmp_path / "runs" / "first", workers=0)
    states = query.ends(tmp_path / "runs" / "first")
    (tmp_path / "next.toml").write_text(scene(f"{GOES_ON}\ndraws = 3"))
    following = expand(load_scene(tmp_path / "next.toml"))
    first = expand(load_scene(tmp_path / "first.toml"))
    assert len(first) == 12
    for one, other in zip(following, first, strict=True):
        assert np.array_equal(one.start(end_of(one))[0], states[other.member_id][0])
    (tmp_path / "next.toml").write_text(scene(GOES_ON))
    with pytest.raises(SceneError, match=r"expected one member of .* got 3, .*-s0-.* and .*-s1-.* first; .*`draws`"):
        ends.check(load_scene(tmp_path / "next.toml"))


def test_a_table_within_a_line_can_be_read_too(first):
    text = 'start = {dataset = "runs/first"}\n' + scene("")
    (first / "next.toml").write_text(text)
    (first / "other.toml").write_text(scene(GOES_ON))
    assert load_scene(first / "next.toml").hash == load_scene(first / "other.toml").hash


def test_a_scene_is_parsed_without_a_look_at_the_dataset_that_it_names(first):
    (first / "next.toml").write_text(scene(GOES_ON))
    following = load_scene(first / "next.toml")
    shutil.rmtree(first / "runs")
    assert parse_scene(following.source).hash == following.hash
    with pytest.raises(SceneError, match=r"start\.dataset: .*no such directory"):
        ends.check(parse_scene(following.source))


def test_a_dataset_that_changed_is_another_start(first):
    (first / "next.toml").write_text(scene(GOES_ON))
    run_ensemble(load_scene(first / "next.toml"), first / "runs" / "next", workers=0)
    (first / "first.toml").write_text(scene(rest="[record]\nend = true").replace("matrices = 2", "matrices = 3"))
    run_ensemble(load_scene(first / "first.toml"), first / "runs" / "first", workers=0)
    with pytest.raises(StoreError, match=r"start\.ends: sha256 [0-9a-f]{12} here, sha256 [0-9a-f]{12} there"):
        run_ensemble(load_scene(first / "next.toml"), first / "runs" / "next", workers=0)


def test_a_dataset_that_changed_since_the_scene_was_read_starts_nothing(first):
    (first / "next.toml").write_text(scene(GOES_ON))
    following = load_scene(first / "next.toml")
    (first / "first.toml").write_text(scene(rest="[record]\nend = true").replace("matrices = 2", "matrices = 3"))
    run_ensemble(load_scene(first / "first.toml"), first / "runs" / "first", workers=0)
    ends._with_ends.cache_clear()  # as in a worker, which opens it later
    with pytest.raises(SceneError, match=r"as it was when the scene was read .* got another"):
        end_of(expand(following)[0])


def test_a_run_that_did_not_come_to_its_end_starts_nothing(tmp_path):
    away = ("n = [4, 6]", "n = [4, 6]\nkappa = 5.0\nrho = 0.1")
    (tmp_path / "first.toml").write_text(scene(rest="[record]\nend = true").replace(*away))
    run_ensemble(load_scene(tmp_path / "first.toml"), tmp_path / "runs" / "first", workers=0)
    assert set(query.members(tmp_path / "runs" / "first").outcome) == {"diverged"}
    (tmp_path / "next.toml").write_text(scene(GOES_ON).replace(*away))
    with pytest.raises(SceneError, match=r"members that came to their end, got n4-m000-.*, which is diverged"):
        ends.check(load_scene(tmp_path / "next.toml"))


BAD = {
    "no dataset": (GOES_ON.replace("first", "none"), "", ["start.dataset", "runs/none", "no such directory"]),
    "other matrices": (GOES_ON, "seed = 1", ["start.dataset", "the same system as n4-m000-e", "seed, n, matrices"]),
    "end of none": ('[start]\nz = "end"\nw = "end"', "", ["start.dataset", '"end"']),
    "draws of none": (f"{GOES_ON}\ndraws = 3", "",
        ["start.dataset", "the same system as n4-m000-s0-e", "and draws must"]),
    "a start beside": (f"{GOES_ON}\nz = 0.0\nw = 0.0", "", ["start.dataset", 'z or w = "end"']),
    "a word": ('[start]\nz = 0.0\nw = "bolt"', "", ["start.w", "'bolt'"]),
    "z on the belt": ('[start]\nz = "belt"\nw = 0.0', "", ["start.z", "'belt'"]),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_start_that_is_none_is_refused_in_a_line_and_nothing_is_written(case, first, capsys, monkeypatch):
    start, seed, words = BAD[case]
    monkeypatch.chdir(first)
    (first / "next.toml").write_text(scene(start).replace("seed = 0", seed or "seed = 0"))
    assert main(["run", "next.toml"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert all(word in line for word in words), line
    print(line)
    assert not (first / "runs" / "next").exists()


def test_a_dataset_without_ends_is_refused(tmp_path):
    (tmp_path / "first.toml").write_text(scene())
    run_ensemble(load_scene(tmp_path / "first.toml"), tmp_path / "runs" / "first", workers=0)
    (tmp_path / "next.toml").write_text(scene(GOES_ON))
    with pytest.raises(SceneError, match=r"start\.dataset: expected .* with the ends of its runs, .*`end = true`"):
        ends.check(load_scene(tmp_path / "next.toml"))


def test_of_one_block_the_numbers_that_were_drawn_are_kept(tmp_path):
    """Of several blocks none fits all; a start that is moved has the numbers of the one that is not."""
    drawn = '[start]\nz = {uniform = [-1, 1]}\nw = "belt"\ndraws = 3'
    text = scene(drawn, rest="[twins]\nsizes = 1e-3").replace("n = [4, 6]", "n = [1, 4]")
    (tmp_path / "one.toml").write_text(text)
    members = {member.member_id: member for member in expand(load_scene(tmp_path / "one.toml"))}
    run_ensemble(load_scene(tmp_path / "one.toml"), tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out")
    one, four = table[table.n == 1], table[table.n == 4]
    assert len(one) == len(four) > 0
    for row in one[one.twin_size.isna()].itertuples():
        assert (row.z0, row.w0) == (members[row.member_id].start()[0][0], row.belt_speed)
    assert one.groupby(["matrix", "start_draw"])["z0"].nunique().eq(1).all()
    assert one.groupby("matrix")["z0"].nunique().eq(3).all()
    assert four.z0.isna().all()
    assert set(table.drawn) == {"z = uniform(-1, 1)"}
