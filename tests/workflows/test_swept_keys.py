"""A report compares runs along the keys that the scene sweeps, and never runs that differ in two of them."""

import pytest

from stickslip.pipeline import parse_scene, query, run_ensemble
from stickslip.workflows import reporting


def scene(system, run="matrices = 8"):
    return parse_scene(
        f'[system]\ncoupling = "chain"\nn = 8\nkappa = 1.0\n{system}\n'
        f'[start]\nz = {{uniform = [-0.5, 0.5]}}\nw = "belt"\n[run]\nt_end = 100.0\n{run}\n'
        '[[engine]]\nname = "coulomb"\ntol = 1e-6\n[record]\nslip_speed = true\ndt = 0.5\n'
        "[analysis]\nt_burn = 20.0\ndt = [1.0]\n"
    )


def compared(path):
    """By key: in how many systems the last value is compared with the first, and the mean change of slip_speed."""
    changes = reporting.report(str(path)).tables["changes"]
    changes = changes[changes.quantity.eq("mean slip_speed") & changes.n_first.gt(0)]
    return {row.key: (row.n_first, row.difference) for row in changes.itertuples()}


@pytest.mark.parametrize(("friction", "ratios"), [("[0.8, 1.0]", (1.2, 1.5)), ("[0.5, 1.0]", (1.5, 3.0))])
def test_a_ratio_is_a_key_of_its_own(friction, ratios, tmp_path):
    """Each change is one key's, at both points of the other; two products of the second grid are equal."""
    low, high = ratios
    swept = scene(f"friction = {friction}\nstatic = [{{ratio = {low}}}, {{ratio = {high}}}]")
    run_ensemble(swept, tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out")
    (a, b), (c, d) = (
        (at[lowest].slip_speed.mean(), at[~lowest].slip_speed.mean())
        for _, at in table.groupby("friction")
        for lowest in [at.static == at.static.min()]
    )
    assert compared(tmp_path / "out") == {
        "friction": (8, pytest.approx((c + d - a - b) / 2)),
        "static": (8, pytest.approx((b + d - a - c) / 2)),
    }


def test_the_diagonal_of_a_grid_that_is_half_done_compares_nothing(tmp_path):
    def interrupt(progress):
        raise KeyboardInterrupt

    system, out = "friction = [0.8, 1.0]\nstatic = 1.3\nbelt_speed = [-0.1, -0.2]", tmp_path / "out"
    run_ensemble(scene(system, 'matrices = 6\nzip = [["friction", "belt_speed"]]'), out, workers=0)
    with pytest.raises(KeyboardInterrupt):
        run_ensemble(scene(system, "matrices = 6"), out, workers=0, on_progress=interrupt)
    assert compared(out) == {}
