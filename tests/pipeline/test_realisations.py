"""Files that carry numbers beside K: keys like those that are swept; and realisations, by number or by file."""

import numpy as np
import pytest

from stickslip.pipeline import SceneError, expand, load_scene, query, run_ensemble
from stickslip.pipeline.design.design import Unit
from stickslip.workflows import reporting

SCENE = """
[system]
coupling = "{coupling}"
{source}
friction = [0.8, 1.0]
[start]
z = {{uniform = [-0.5, 0.5]}}
w = "belt"
[run]
t_end = 40.0
matrices = {matrices}
[[engine]]
name = "coulomb"
tol = 1e-6
[record]
slip_speed = true
dt = 0.5
[analysis]
t_burn = 5.0
dt = [1.0]
"""


def chain(n, coupling):
    return coupling * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)) + 0.1 * np.eye(n)


def written(folder, source='path = "K*.npz"\nrho = 0.1', coupling="file", matrices=1):
    path = folder / "scene.toml"
    path.write_text(SCENE.format(coupling=coupling, source=source, matrices=matrices))
    return load_scene(path)


def test_a_number_that_files_carry_is_a_key_that_is_swept(tmp_path):
    """Of each of eight realisations one file at each value, the two ends of a comparison."""
    for k, rewiring in enumerate((0.0, 0.1, 0.2)):
        for number in range(8):
            rng = np.random.default_rng([number])
            matrix = chain(6, 1.0 + rewiring) + np.diag(rng.uniform(0.0, 0.1, 6))
            np.savez(tmp_path / f"K{k}-{number}.npz", stiffness=matrix, rewiring=rewiring, realisation=number)
    scene = written(tmp_path)
    design = expand(scene).ensemble.design
    assert [axis.name for axis in design.axes] == ["rewiring", "friction"]
    assert {source.unit for source in design.sources} == {Unit.FILE}
    starts = {}  # as a function's settings do, files of one realisation share what is drawn
    for member in expand(scene):
        starts.setdefault(dict(member.source.parameters)["realisation"], set()).add(tuple(member.start()[0]))
    assert [len(of_unit) for of_unit in starts.values()] == [1] * 8
    assert len(set.union(*starts.values())) == 8
    run_ensemble(scene, tmp_path / "data", workers=0)
    rows = query.members(tmp_path / "data")
    assert sorted(rows["rewiring"].unique()) == [0.0, 0.1, 0.2]
    assert rows.groupby("design_point").size().tolist() == [8] * 6
    assert sorted(rows["design_unit"].unique()) == [*range(8)]
    table = reporting.study_of(tmp_path / "data").data.table
    assert [table.unit_of(name) for name in rows["member_id"]] == rows["file"].tolist()
    changes = reporting.report(tmp_path / "data").tables["changes"]
    known = changes[changes["quantity"] == "mean slip_speed"]
    assert known.groupby("key")["n_first"].max().to_dict() == {"friction": 8, "rewiring": 8}


def test_draws_of_a_file_are_told_by_their_number(tmp_path):
    np.savez(tmp_path / "K0.npz", stiffness=chain(4, 1.0))
    assert [*reporting._systems(written(tmp_path, matrices=2)).values()] == ["K0.npz, draw 0", "K0.npz, draw 1"]


def test_files_that_share_all_their_numbers_are_refused(tmp_path):
    """They would count as one system."""
    for k in range(2):
        np.savez(tmp_path / f"K{k}.npz", stiffness=chain(4, 1.0 + k), rewiring=0.1, realisation=7)
    with pytest.raises(SceneError, match=r"path: expected a `realisation` of its own .* got 7 in K0.npz and K1.npz"):
        written(tmp_path)


def test_files_without_a_number_of_their_own_are_realisations_too(tmp_path):
    """Equal ones among them: without rewiring all come out the same."""
    for number in range(3):
        np.savez(tmp_path / f"K0-{number}.npz", stiffness=chain(4, 1.0), rewiring=0.0)
        np.savez(tmp_path / f"K1-{number}.npz", stiffness=chain(4, 1.0 + number), rewiring=0.1)
    members = [*expand(written(tmp_path))]
    assert len({member.member_id for member in members}) == len(members) == 12
    numbering = expand(written(tmp_path)).ensemble
    of = numbering.coordinates(np.arange(12))
    assert len(np.unique(of.unit)) == 6
    assert np.bincount(of.point).tolist() == [3] * 4
    starts = {tuple(np.round(member.start()[0], 12)) for member in members if member.term("friction") == 1.0}
    assert len(starts) == 6, "each is drawn for itself"


def test_starts_of_two_files_are_no_pairs(tmp_path):
    """What is drawn depends on the content of a file."""
    for k in range(2):
        np.savez(tmp_path / f"K{k}.npz", stiffness=chain(4, 1.0 + k), rewiring=0.1 * k)
    path = tmp_path / "scene.toml"
    written(tmp_path)
    path.write_text(path.read_text().replace('w = "belt"', 'w = "belt"\ndraws = 5'))
    members = expand(load_scene(path))
    of, starts = members.ensemble.coordinates(members.places), [tuple(member.start()[0]) for member in members]
    alike = {(unit, start) for unit, start in zip(of.unit.tolist(), starts, strict=True)}
    assert len(alike) == len({unit for unit, _ in alike}) == len({*starts}) == 10


def test_every_file_carries_the_same_numbers(tmp_path):
    np.savez(tmp_path / "K0.npz", stiffness=chain(4, 1.0), rewiring=0.0)
    np.savez(tmp_path / "K1.npz", stiffness=chain(4, 2.0))
    with pytest.raises(SceneError, match="expected the same numbers in each file, got one without `rewiring`"):
        written(tmp_path)
    np.savez(tmp_path / "K1.npz", stiffness=chain(4, 2.0), rewiring=[0.1, 0.2])
    with pytest.raises(SceneError, match="and numbers by other names, got stiffness, rewiring"):
        written(tmp_path)


def test_a_function_that_takes_it_is_given_the_number_of_the_realisation(tmp_path):
    (tmp_path / "mine.py").write_text(
        "import numpy as np\nfrom stickslip import System\n\n"
        "def made(n, rng, realisation):\n    return System(np.eye(n) * (1.0 + realisation), 0.1)\n"
    )
    members = [*expand(written(tmp_path, "n = 3", "mine:made", matrices=3))]
    assert [member.system().stiffness[0, 0] for member in members] == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0]
