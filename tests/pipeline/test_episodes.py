"""Episodes as a table of a dataset."""

import numpy as np
import pytest

from stickslip import Dataset
from stickslip.pipeline import QueryError, expand, parse_scene, query, run_ensemble, verify
from stickslip.pipeline.records.slips.episodes import EpisodesRecord
from stickslip.sim.episodes import episodes
from tests.scenes import COULOMB, ON_BELTS, SIGMOID, ensemble

SOURCE = ensemble(
    5,
    100.0,
    2,
    COULOMB,
    SIGMOID,
    seed="SEED",
    system='coupling = "chain"\nkappa = 4.0\nleaf = 1.0\nrho = 0.2\nstatic = [1.0, 1.4]\nbelt_speed = -0.05',
    start=ON_BELTS,
    rest="[record]\nepisodes = true",
)


@pytest.fixture(scope="module")
def scene(module_seed):
    return parse_scene(SOURCE.replace("SEED", str(module_seed)).encode())


def test_a_row_an_episode_of_every_member(scene, tmp_path):
    run_ensemble(scene, tmp_path / "out", workers=0)
    table = Dataset(tmp_path / "out").episodes
    assert list(table) == ["member_id", "start", "end", "size", "moment", "first_block", "z_sum"]
    for member in expand(scene):
        own = table[table.member_id == member.member_id]
        found = episodes(member.simulate(), member.term("belt_speed"))
        for name in list(table)[1:]:
            np.testing.assert_array_equal(own[name], getattr(found, name))
        assert len(own) == 0 or member.term("static") == 1.4  # without it all come to slip
    assert {"coulomb", "sigmoid"} <= {name.split("-")[4] for name in table.member_id}
    found = query.sql(
        tmp_path / "out", 'SELECT member_id, start, "end", size, moment, first_block, z_sum FROM episodes'
    )
    assert found.equals(table)


def test_slip_and_strain_are_the_whole_travel_by_the_exact_law(scene):
    """No block creeps by the exact law; smoothed, all that is stuck does, by what the samples say it does.

    Both are identities of the numbers that a run records, whatever its error: they hold to rounding, which is below
    the number of terms, some thousands, times eps. They were within 6e-16.
    """
    for member in expand(scene.changed(run={"t_end": 400.0})):
        run = member.simulate()
        found = episodes(run, -0.05)
        if len(found) == 0:  # as without the larger static friction: all come to slip
            continue
        travel = 5 * 0.05 * (found.start[-1] - found.start[0])
        rest = travel - found.moment[:-1].sum() + found.z_sum[-1] - found.z_sum[0]
        times = np.column_stack([found.end[:-1], found.start[1:]]).ravel()
        total = member.simulate(times).samples.z.sum(axis=1).reshape(-1, 2)
        crept = np.diff(total, axis=1)[:, 0] + 5 * 0.05 * (found.start[1:] - found.end[:-1])
        rounding = 1e-12 * (travel + np.abs(found.z_sum).max() + found.moment.sum())
        assert rest == pytest.approx(crept.sum(), rel=0, abs=rounding)
        assert crept.all() if member.engine == "sigmoid" else abs(rest) <= rounding


def test_stopped_and_resumed_is_as_never_stopped(scene, content, tmp_path):
    class Stop(Exception):
        pass

    def stop(progress):
        if progress.n_done:
            raise Stop

    run_ensemble(scene, tmp_path / "whole", workers=0)
    with pytest.raises(Stop):
        run_ensemble(scene, tmp_path / "out", workers=0, on_progress=stop)
    assert len(query.episodes(tmp_path / "out")) < len(query.episodes(tmp_path / "whole"))
    run_ensemble(scene, tmp_path / "out", workers=0)
    assert verify(tmp_path / "out") == []
    assert content(tmp_path / "out") == content(tmp_path / "whole")


def test_only_where_the_scene_asks(scene, tmp_path):
    silent = scene.changed(record={"episodes": False}, run={"t_end": 2.0})
    run_ensemble(silent, tmp_path / "out", workers=0)
    for ask in (query.episodes, lambda path: query.sql(path, "SELECT * FROM episodes")):
        with pytest.raises(QueryError, match="`episodes = true` under"):
            ask(tmp_path / "out")


def test_data_of_a_version_that_lacked_a_column_are_sound_and_read_as_null(scene, tmp_path, monkeypatch):
    later = next(column for column in EpisodesRecord.columns if column.name == "episode_z_sum")
    assert later.is_later
    with monkeypatch.context() as patch:
        lacking = tuple(column for column in EpisodesRecord.columns if column is not later)
        patch.setattr(EpisodesRecord, "columns", lacking)
        run_ensemble(scene, tmp_path / "out", workers=0)
        assert "z_sum" not in query.episodes(tmp_path / "out")
    table = query.episodes(tmp_path / "out")
    assert len(table) > 0
    assert table["z_sum"].isna().all()
    assert not table["moment"].isna().any()
    assert verify(tmp_path / "out") == []
