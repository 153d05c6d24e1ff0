"""A dataset with episodes and energy, swept: its report says what SQL finds in the same rows."""

import numpy as np
import pytest

from stickslip.analysis import measures
from stickslip.analysis.questions.runs.changes import answer as changes_of
from stickslip.pipeline import parse_scene, query, run_ensemble
from stickslip.workflows.reporting import study_of
from tests.scenes import COULOMB, ON_BELTS, ensemble

SCENE = ensemble(
    6,
    120.0,
    5,
    COULOMB,
    system='coupling = "chain"\nkappa = 4.0\nleaf = 1.0\nrho = 0.2\nstatic = 1.4\nbelt_speed = -0.1\n'
    'weakening = {law = "rational", rate = [0.5, 5.0]}',
    start=ON_BELTS,
    rest="[record]\nepisodes = true\nenergy = true",
    analysis="t_burn = 20.0\ndt = 0.5",
)


def test_a_swept_chain_tells_of_its_episodes_and_then_of_its_energy(tmp_path):
    place = str(tmp_path / "chain")
    run_ensemble(parse_scene(SCENE.encode()), place, workers=0)
    answer = changes_of(study_of(place))
    table = answer.tables["sweep_measures"].set_index(["measure", "weakening_rate"])
    members, episodes = query.members(place), query.episodes(place)
    rate_of = members.set_index("member_id")["weakening_rate"]
    counted = episodes[episodes["start"] >= 20.0]["member_id"].map(rate_of).value_counts()
    for rate, some in members.groupby("weakening_rate"):
        assert table.loc[("rate of episodes", rate), "estimate"] == pytest.approx(counted.get(rate, 0) / (5 * 100.0))
        lost = some["friction_loss"].to_numpy(float)
        row = table.loc[("mean friction_loss", rate)]
        assert row["estimate"] == pytest.approx(lost.mean())
        half = 2.776445 * lost.std(ddof=1) / np.sqrt(5)  # Student's t with four degrees of freedom, 97.5%
        assert row["estimate_high"] - row["estimate"] == pytest.approx(half, rel=1e-5)
        assert row["words"] == "what slip on the belt took, as heat"
    assert answer.findings[0].quantity.key == "rate of episodes"
    assert next(iter(answer.figures)) == "sweep_of_episode_rate"


def test_a_sweep_with_certificates_is_about_the_motion_and_not_about_when_they_came(tmp_path):
    """A certificate comes later than the last stick, and of those runs alone that collapse."""
    for k, record in enumerate(("collapse = true", "collapse = false")):
        scene = SCENE.replace("episodes = true\nenergy = true", record)
        place = str(tmp_path / str(k))
        run_ensemble(parse_scene(scene.encode()), place, workers=0)
        study = study_of(place)
        table = changes_of(study).tables["changes"]
        assert measures.MEAN in set(table["quantity"])
        assert not table["quantity"].str.contains("collapse").any()
