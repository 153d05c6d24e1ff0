"""Energy as columns of a dataset: the balance closes."""

import numpy as np
import pytest

from stickslip import Dataset
from stickslip.pipeline import SceneError, expand, parse_scene, query, run_ensemble, verify
from stickslip.sim.energy import energy
from tests.scenes import COULOMB, ensemble

EXACT, STEPS = f"{COULOMB}\ntol = 1e-13", 'name = "moreau"\nstep = 0.1'
SOURCE = ensemble(
    6,
    80.0,
    3,
    EXACT,
    STEPS,
    seed="SEED",
    system='coupling = "chain"\nkappa = 2.0\nleaf = 1.0\nrho = 0.1\nstatic = 1.4\nbelt_speed = -0.1\nTERMS',
    start='z = {uniform = [-0.3, 0.3]}\nw = "belt"',
    rest="[record]\nenergy = true\nepisodes = true",
)
MOREAU = f"[[engine]]\n{STEPS}\n"
TERMS = {
    "dry": "",
    "driven": "force = {amplitude = 0.2, frequency = 0.7}",
    "weakening": 'weakening = {law = "rational", rate = 2.0}',
    "massive": "mass = {uniform = [0.5, 2.0]}",
    "not reciprocal": "",
}
STORED = ("kinetic_energy", "elastic_energy")
GIVEN, TAKEN = ("belt_work", "force_work", "coupling_work"), ("damping_loss", "friction_loss")


def scene(terms, seed, source=SOURCE):
    source = source.replace("TERMS", TERMS[terms]).replace("SEED", str(seed))
    if terms in ("driven", "weakening"):
        source = source.replace(MOREAU, "")
    if terms == "not reciprocal":
        source = source.replace('"chain"', '"antisymmetric"').replace("leaf = 1.0\nrho = 0.1\n", "rho = 3.5\n")
    return parse_scene(source.encode())


@pytest.mark.parametrize("terms", TERMS)
def test_the_balance_closes(terms, tmp_path, random_seed):
    ensemble = scene(terms, random_seed)
    run_ensemble(ensemble, tmp_path / "out", workers=0)
    assert verify(tmp_path / "out") == []
    table = query.members(tmp_path / "out")
    exact = table[table.engine == "coulomb"]
    stored = sum(exact[f"{name}_end"] - exact[f"{name}_start"] for name in STORED)
    given, taken = (sum(exact[name] for name in names) for names in (GIVEN, TAKEN))
    assert np.abs(stored - given + taken).max() < 1e-11 * (taken.max() + exact[list(GIVEN)].abs().max().max())
    assert (taken > 0.01).all()
    assert (exact.force_work != 0).all() == (terms == "driven")
    assert (exact.coupling_work != 0).all() == (terms == "not reciprocal")
    others = table[table.engine != "coulomb"]
    assert others[[f"{name}_end" for name in STORED] + [*GIVEN, *TAKEN]].isna().all(axis=None)


def test_an_episode_has_what_is_lost_in_it(tmp_path, random_seed):
    ensemble = scene("dry", random_seed)
    run_ensemble(ensemble, tmp_path / "out", workers=0)
    table = Dataset(tmp_path / "out").episodes
    assert table.energy.isna().any()  # of time stepping
    for member in expand(ensemble):
        own = table[table.member_id == member.member_id]
        if member.engine != "coulomb":
            assert own.energy.isna().all()
            continue
        found = energy(member.system(), member.simulate(), *member.start(), tol=1e-13)
        lost = [np.interp(own[end], found.t, found.damping + found.heat) for end in ("start", "end")]
        np.testing.assert_allclose(own.energy, lost[1] - lost[0], rtol=1e-13)
        assert (own.energy > 0).all()
    found = query.sql(tmp_path / "out", "SELECT energy FROM episodes")
    np.testing.assert_array_equal(
        found.energy.to_numpy(dtype=float, na_value=np.nan), table.energy.to_numpy(dtype=float, na_value=np.nan)
    )


def test_it_changes_nothing_else_and_costs_nothing_where_it_is_not_asked(tmp_path, random_seed):
    ensemble = scene("dry", random_seed)
    plain = ensemble.changed(record={"energy": False, "episodes": True})
    assert "energy" not in plain.data_keys()["record"]
    for name, one in (("with", ensemble), ("without", plain)):
        run_ensemble(one, tmp_path / name, workers=0)
    table = query.members(tmp_path / "with")
    assert table[list(query.members(tmp_path / "without"))].equals(query.members(tmp_path / "without"))
    assert [one.member_id for one in expand(plain)] == [one.member_id for one in expand(ensemble)]


def test_a_run_that_diverged_has_no_energy_and_keeps_all_else(tmp_path, random_seed):
    source = SOURCE.replace('"chain"', '"antisymmetric"').replace("kappa = 2.0\nleaf = 1.0", "kappa = 5.0")
    run_ensemble(scene("dry", random_seed, source), tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out")
    exact = table[table.engine == "coulomb"]
    assert (exact.outcome == "diverged").all()
    assert (exact.n_events > 0).all()
    assert table[[f"{name}_end" for name in STORED] + [*GIVEN, *TAKEN]].isna().all(axis=None)
    assert query.episodes(tmp_path / "out").energy.isna().all()


def test_a_run_too_long_to_sum_keeps_all_else(tmp_path, monkeypatch, random_seed):
    monkeypatch.setattr("stickslip.sim.energy._MOST", 10)
    run_ensemble(scene("dry", random_seed), tmp_path / "out", workers=0)
    assert verify(tmp_path / "out") == []
    table = Dataset(tmp_path / "out").members
    assert (table.outcome != "failed").all()
    assert (table[table.engine == "coulomb"].n_events > 10).all()
    assert table[[f"{name}_end" for name in STORED] + [*GIVEN, *TAKEN]].isna().all(axis=None)
    found = Dataset(tmp_path / "out").episodes
    assert len(found) > 0
    assert found.energy.isna().all()


def test_without_an_engine_of_the_exact_law_it_is_refused(random_seed):
    with pytest.raises(
        SceneError, match=r"record.energy: expected an engine of the exact law, got 'moreau' alone; add"
    ):
        scene("dry", random_seed, SOURCE.replace(f"[[engine]]\n{EXACT}\n", ""))


def test_it_is_kept_of_runs_that_are_tested_for_collapse(tmp_path):
    """Their last digits are others than without the test, and the energy is that of the run that is kept."""
    source = SOURCE.replace("energy = true\n", "energy = true\ncollapse = true\n").replace(MOREAU, "")
    for old, new in {"n = 6": "n = 5", "rho = 0.1": "rho = 3.5", "t_end = 80.0": "t_end = 12.0"}.items():
        source = source.replace(old, new)
    run_ensemble(scene("dry", 0, source), tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out")
    assert (table.outcome != "failed").all(), table.reason.dropna().iloc[0]
    assert table.kinetic_energy_end.notna().all()
