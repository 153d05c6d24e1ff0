"""Scene files: what is read, what is refused, and in which words."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import pytest

from stickslip.pipeline import SceneError, expand, load_scene, parse_scene, run_ensemble

SCENES = Path(str(resources.files("stickslip.workflows"))) / "scenes"


def edit(source, old, new):
    text = source.decode()
    assert text.count(old) == 1, old
    return text.replace(old, new).encode()


def test_defaults_and_lists(scene):
    assert scene.system.n == (3, 5)  # one way to say it: ascending
    assert scene.analysis.dt == (0.5,)
    assert (scene.system.kappa, scene.system.rho, scene.system.belt_speed) == (0.2, 3.5, -0.2)
    coulomb, sigmoid = scene.engines
    assert coulomb.tol == 1e-10
    assert (sigmoid.eps, sigmoid.rtol, sigmoid.atol, sigmoid.threshold) == (0.03, 1e-8, 1e-8, 1.0)
    assert scene.perturbation.draws == 1


def test_a_range_of_magnitudes_is_kept(scene):
    declared = scene.changed(analysis={"magnitude_range": [-1, 0.5]})
    assert declared.analysis.magnitude_range == (-1.0, 0.5)
    assert declared.changed(analysis={"smallest": 2}).analysis.magnitude_range == (-1.0, 0.5)


@pytest.mark.parametrize("name", ["quick", "cascades"])
def test_shipped_scenes_load_and_explain_each_key(name):
    file = SCENES / f"{name}.toml"
    assert load_scene(file).title
    lines = file.read_text().splitlines()
    assert [line for line in lines if "=" in line and "#" not in line] == []


# what is changed in the small scene; the words that its message must hold: the key, and what helps
BAD = {
    "unknown key": ("t_end = 8.0", "t_ned = 8.0\nt_end = 8.0", ["run.t_ned", "did you mean 't_end'"]),
    "unknown key, nothing like it": ("seed = 7", "colour = 7", ["run.colour", "t_end, matrices, seed"]),
    "empty key": ("seed = 7", "seed = 7\n'' = 1", ["run.'': unknown key of [run]", "t_end, matrices, seed"]),
    "empty key of the scene": ('title = "small"', "'' = 1", ["'': unknown key of a scene"]),
    "unknown table": ("[record]\nevents = true", "[recrod]\nevents = true", ["recrod", "did you mean 'record'"]),
    "unknown engine key": ("ratio_draws = 2", "ratio_drawz = 2", ["engine[1].ratio_drawz", "'ratio_draws'"]),
    "key of the other engine": ('name = "coulomb"', 'name = "coulomb"\neps = 0.1', ["engine[0].eps", "name, tol"]),
    "missing table": ("[run]\nt_end = 8.0\nmatrices = 3\nseed = 7", "", ["run:", "add [run]"]),
    "missing key": ("t_end = 8.0\n", "", ["run.t_end", "add `t_end = 1000.0`"]),
    "text for a number": ("t_end = 8.0", 't_end = "long"', ["run.t_end", "number", "'long'", "`t_end = 1000.0`"]),
    "number for a count": ("matrices = 3", "matrices = 3.5", ["run.matrices", "integer", "3.5"]),
    "true for a number": ("t_end = 8.0", "t_end = true", ["run.t_end", "number", "True"]),
    "number for text": ('coupling = "antisymmetric"', "coupling = 1", ["system.coupling", "string", "1"]),
    "value for a table": ("[record]\nevents = true", "[record.events]", ["record.events", "boolean"]),
    "negative n": ("n = [5, 3]", "n = -5",
        ["system.n[0]", "greater than or equal to 1", "-5", "`n = 200`", "number of blocks"]),
    "huge n": ("n = [5, 3]", "n = 10000000000", ["system.n[0]", "100000", "10000000000"]),
    "empty n": ("n = [5, 3]", "n = []", ["system.n", "at least one value", "[]"]),
    "doubled n": ("n = [5, 3]", "n = [5, 3, 5]", ["system.n", "got 5 more than once", "remove"]),
    "doubled size": ("sizes = [0.05, 0.01]", "sizes = [0.05, 0.05]", ["perturbation.sizes", "0.05 more than once"]),
    "zero size": ("sizes = [0.05, 0.01]", "sizes = [0.0]", ["perturbation.sizes[0]", "greater than 0"]),
    "nan": ("t_end = 8.0", "t_end = nan", ["run.t_end", "finite", "nan"]),
    "negative time": ("t_end = 8.0", "t_end = -8.0", ["run.t_end", "greater than 0", "-8.0"]),
    "no matrices": ("matrices = 3", "matrices = 0", ["run.matrices", "greater than or equal to 1"]),
    "negative seed": ("seed = 7", "seed = -7", ["run.seed", "greater than or equal to 0"]),
    "huge seed": ("seed = 7", "seed = 9223372036854775808", ["run.seed", "less than 9223372036854775808"]),
    "unknown coupling": ('"antisymmetric"', '"antisymetric"', ["system.coupling", "did you mean 'antisymmetric'"]),
    "unknown engine": ('name = "coulomb"', 'name = "colomb"', ["engine[0].name", "did you mean 'coulomb'"]),
    "tolerance out of reach": ('name = "coulomb"', 'name = "coulomb"\ntol = 1e-17',
        ["engine[0].tol", "greater than 1e-16, got 1e-17"]),
    "engine without name": ('name = "coulomb"', "tol = 1e-9", ["engine[0].name", 'write `name = "coulomb"`']),
    "same engine twice": ('[[engine]]\nname = "coulomb"',
        '[[engine]]\nname = "coulomb"\n[[engine]]\nname = "coulomb"\ntol = 1e-10',
        ["engine[1]", "engine[0]", "remove it"]),
    "engines that no name tells apart": (
        '[[engine]]\nname = "coulomb"',
        '[[engine]]\nname = "sigmoid"\neps = 0.07\n[[engine]]\nname = "sigmoid"\neps = 0.07\nthresholds = [0.5]\n'
        '[[engine]]\nname = "coulomb"',
        ["engine[1]", "other names than those of engine[0]", "one table"],
    ),
    "unknown ratio": ('ratio = "uniform"', 'ratio = "random"', ["engine[1].ratio", "'one' or 'uniform'", "'random'"]),
    "draws of nothing": ('ratio = "uniform"', 'ratio = "one"',
        ["engine[1].ratio_draws", 'ratio = "uniform"', "remove"]),
    "thresholds below zero": ('stick = "threshold"', 'stick = "threshold"\nthresholds = [-1.0]',
        ["engine[1].thresholds[0]", "greater than 0", "-1.0"]),
    "unknown reading": ("sizes = [0.05, 0.01]", 'sizes = [0.05, 0.01]\nreadings = ["damping"]',
        ["perturbation.readings[0]", "'damping matrix'", "'damping'"]),
    "a damping matrix for an engine without": ("sizes = [0.05, 0.01]",
        'sizes = [0.05, 0.01]\nreadings = "damping matrix"\n\n[[engine]]\nname = "moreau"',
        ["engine[2].readings", "diagonal", "readings = []"]),
    "Rayleigh's damping beside another": ('coupling = "antisymmetric"',
        'coupling = "antisymmetric"\nrho = 2.0\nrayleigh = [0.1, 0.2]',
        ["system", "rayleigh: expected either `rayleigh` or `rho`", "remove one"]),
    "three numbers of Rayleigh's damping": ('coupling = "antisymmetric"',
        'coupling = "antisymmetric"\nrayleigh = [0.1, 0.2, 0.3]',
        ["system.rayleigh", "two numbers, a and b", "[0.1, 0.2, 0.3]"]),
    "Rayleigh's damping of what is perturbed": ('coupling = "antisymmetric"',
        'coupling = "antisymmetric"\nrayleigh = [0.1, 0.2]',
        ["perturbation.readings", "with `rayleigh`", "remove [perturbation]"]),
    "a reading that is not there": ('name = "coulomb"', 'name = "coulomb"\nreadings = ["relative"]',
        ["engine[0].readings", "['scale']", "'relative'", "add it there"]),
    "the same reading twice": ("sizes = [0.05, 0.01]", 'sizes = [0.05, 0.01]\nreadings = ["scale", "scale"]',
        ["perturbation.readings", "once", "remove"]),
    "a drive of no block": ('coupling = "antisymmetric"',
        'coupling = "antisymmetric"\ndrive = {speed = 1.0, stiffness = 1.0}',
        ["system.drive.block: expected the block that the drive is tied to", "found nothing; add"]),
    "twins that are no twins": ("[record]", "[twins]\nsizes = [0.0]\n[record]",
        ["twins.sizes[0]", "greater than 0", "0.0"]),
    "unknown purpose": ("seed = 7", 'seed = 7\npurpose = "beauty"', ["run.purpose", "'paths'", "'beauty'"]),
    "threshold of nothing": ('stick = "threshold"', 'stick = "manifold"\nthreshold = 2.0',
        ["engine[1].threshold", 'stick = "threshold"', "remove"]),
    "wide sigmoid": ('stick = "threshold"', "eps = 2.0", ["engine[1].eps", "less than 1", "2.0"]),
    "perturbed springs": ('"antisymmetric"', '"springs"',
        ["perturbation.readings", "springs", 'readings = ["relative"]']),
    "burn-in too long": ("t_burn = 1.0", "t_burn = 8.0", ["analysis.t_burn", "run.t_end = 8.0", "shorten"]),
    "margin of nothing": ("t_burn = 1.0", "t_burn = 1.0\nmargins.meen = 0.1",
        ["analysis.margins.meen", "did you mean 'mean'"]),
    "margin in percent of nothing": ("t_burn = 1.0", "t_burn = 1.0\nmargins.mean = 0.0",
        ["analysis.margins.mean", "greater than 0", "`mean = 0.05`"]),
    "published share in percent": ("t_burn = 1.0", "t_burn = 1.0\npublished.sliding = 30.71",
        ["analysis.published.sliding", "less than or equal to 1"]),
    "published share of nothing": ("t_burn = 1.0", "t_burn = 1.0\npublished.sliding_ = 0.3",
        ["analysis.published.sliding_", "did you mean 'sliding'"]),
    "magnitudes the wrong way round": ("t_burn = 1.0", "t_burn = 1.0\nmagnitude_range = [0.5, -1.0]",
        ["analysis.magnitude_range", "second by 0.5 or more the larger, got [0.5, -1.0]", "write e.g."]),
    "one magnitude": ("t_burn = 1.0", "t_burn = 1.0\nmagnitude_range = 0.5",
        ["analysis.magnitude_range", "two magnitudes", "got 0.5"]),
    "confidence of certainty": ("t_burn = 1.0", "t_burn = 1.0\nconfidence = 0.9999999999999999",
        ["analysis.confidence", "less than or equal to 0.999999", "`confidence = 0.95`"]),
    "draws beyond counting": ("ratio_draws = 2", "ratio_draws = 1000000000000", ["10000000", "number of draws"]),
    "number in quotes": ("t_end = 8.0", 't_end = "8e0"', ["run.t_end", "number", "write it without quotes: 8e0"]),
    "count in quotes": ("matrices = 3", 'matrices = "3.5"', ["run.matrices", "integer", "`matrices = 20`"]),
    "several ways to stick": ('stick = "threshold"', 'stick = ["threshold"]', ["engine[1].stick", "'threshold'"]),
    "table twice, once as a value": ("[system]", "record = 3\n[system]", ["TOML", "correct that line"]),
    "doubled step": ("dt = 0.5", "dt = [0.5, 0.50]", ["analysis.dt", "more than once"]),
    "negative step": ("dt = 0.5", "dt = [-0.5]", ["analysis.dt", "greater than 0"]),
    "steps without end": ("dt = 0.5", "dt = [1e-300]", ["analysis.dt", "at least 8e-07, run.t_end / 10000000"]),
    "steps without number": ("dt = 0.5", f"dt = {list(range(1, 300_001))}",
        ["analysis.dt", "at most 1000 values, got 300000"]),
    "distances without number": ("events = true", "separation = 1e-300", ["record.separation", "at least 8e-07"]),
    "twins that are one": ("[record]", "[twins]\nsizes = [1e-17]\n[record]", ["twins.sizes", "float64 resolves"]),
    "changes of nothing": ("sizes = [0.05, 0.01]", "sizes = 1e-300", ["perturbation.sizes", "float64 resolves"]),
    "doubled table": ("[start]", "[system]\nn = 3\n[start]", ["TOML", "correct that line"]),
    "doubled key": ("seed = 7", "seed = 7\nseed = 8", ["TOML", "line 15"]),
    "not TOML": ("t_end = 8.0", "t_end 8.0", ["TOML", "line 12"]),
    "endless integer": ("seed = 7", "seed = " + "9" * 5000, ["TOML"]),
    "barred on a belt at rest": ("n = [5, 3]", "n = [5, 3]\nback_slip = false\nbelt_speed = [-0.1, 0.0]",
        ["system.belt_speed", "neither rests nor turns, got 0.0", "remove"]),
    "barred on a belt that turns": ("n = [5, 3]",
        "n = [5, 3]\nback_slip = false\nbelt_speed = {times = [0, 9], values = [-0.1, 0.1]}",
        ["system.belt_speed", "neither rests nor turns, got -0.1 at 0 to 0.1 at 9", "remove"]),
    "integer beyond float": ("t_end = 8.0", "t_end = " + "9" * 400, ["run.t_end", "number"]),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_scene_is_refused_with_key_and_remedy(case, source, tmp_path):
    old, new, words = BAD[case]
    file = tmp_path / "scene.toml"
    file.write_bytes(edit(source, old, new))
    with pytest.raises(SceneError) as caught:
        load_scene(file)
    lines = str(caught.value).splitlines()
    assert any(all(word in line for word in words) for line in lines), str(caught.value)
    assert all(line.startswith(f"{file}: ") for line in lines)
    assert list(tmp_path.iterdir()) == [file]


def test_a_belt_may_come_to_rest_where_one_side_is_barred(source):
    """As `System` has it: it loads to one side for as long as it moves."""
    text = edit(
        source, "n = [5, 3]", "n = [5, 3]\nback_slip = false\nbelt_speed = {times = [0, 9], values = [-0.1, 0]}"
    )
    assert not expand(parse_scene(text))[0].system().back_slip


def test_no_engine_at_all(source):
    head, _, rest = source.decode().partition("[[engine]]")
    without = head + rest[rest.index("[perturbation]") :]
    with pytest.raises(SceneError, match=r"engine: expected a table, found none; add \[\[engine\]\]"):
        parse_scene(without.encode())
    with pytest.raises(SceneError, match="engine: expected at least one value"):
        parse_scene(("engine = []\n" + without).encode())
    with pytest.raises(SceneError, match=r"engine\[0\]: expected a table, got 'coulomb'; write \[\[engine\]\]"):
        parse_scene(('engine = "coulomb"\n' + without).encode())
    with pytest.raises(SceneError, match=r"record: expected a table, got 3; write \[record\]"):
        parse_scene(edit(source, "[record]\nevents = true", "").replace(b"title", b"record = 3\ntitle"))


def test_every_problem_has_its_line(source):
    bad = edit(edit(source, "seed = 7", "sed = 7"), "z = -0.7", "z = inf")
    with pytest.raises(SceneError) as caught:
        parse_scene(bad, "a.toml")
    assert [line.split(":")[1].strip() for line in str(caught.value).splitlines()] == ["start.z", "run.sed"]


def test_empty_file_asks_for_every_table():
    with pytest.raises(SceneError) as caught:
        parse_scene(b"")
    for table in ("[system]", "[start]", "[run]", "[[engine]]", "[analysis]"):
        assert f"add {table} " in str(caught.value)


def test_unreadable_files(tmp_path):
    with pytest.raises(SceneError, match=r"none\.toml: expected a scene file, found nothing.*check the path"):
        load_scene(tmp_path / "none.toml")
    with pytest.raises(SceneError, match="got a directory; name the"):
        load_scene(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b'\n\ntitle = "caf\xe9"')
    with pytest.raises(SceneError, match="line 3: expected UTF-8 text, got byte 0xe9; save the file as UTF-8"):
        load_scene(tmp_path / "latin.toml")


def test_hash_is_of_what_determines_the_data(scene, source):
    same = [
        ('title = "small"', 'title = "other"\nabout = "text"'),
        ("t_burn = 1.0", "t_burn = 2.0"),
        ("n = [5, 3]", "n = [3, 5]  # another order"),
        ("t_end = 8.0", "t_end = 8"),
    ]
    for old, new in same:
        assert parse_scene(edit(source, old, new)).hash == scene.hash, new
    others = [
        ("seed = 7", "seed = 8"),
        ("z = -0.7", "z = -0.70000001"),
        ("events = true", "events = false"),
        ("events = true", "events = true\nend = true"),
        ('name = "coulomb"', 'name = "coulomb"\ntol = 1e-9'),
        ("sizes = [0.05, 0.01]", "sizes = [0.05]"),
    ]
    hashes = {parse_scene(edit(source, old, new)).hash for old, new in others}
    assert len(hashes | {scene.hash}) == len(others) + 1


def test_a_key_younger_than_a_dataset_does_not_make_it_another_scene(source):
    assert "end" not in parse_scene(source).data_keys()["record"]


def test_tolerances_are_picked_for_what_a_scene_asks(scene, source):
    """Events and moved constants ask for paths; n_stick alone for statistics; what is given stands, and is said."""
    assert (scene.purpose, [engine.picked_for for engine in scene.engines]) == ("paths", ["paths", "paths"])
    moved = parse_scene(edit(source, "events = true", "events = false"))
    assert moved.engines[0].tolerances == {"tol": 1e-10}
    plain = edit(edit(source, "events = true", "events = false"), "[perturbation]\nsizes = [0.05, 0.01]", "")
    picked = parse_scene(plain)
    assert [engine.tolerances for engine in picked.engines] == [{"tol": 1e-5}, {"rtol": 1e-5, "atol": 1e-5}]
    assert {member.method.picked_for for member in expand(picked)} == {"statistics"}
    given = parse_scene(
        edit(edit(plain, 'name = "coulomb"', 'name = "coulomb"\ntol = 1e-5'), "ratio_draws = 2", "rtol = 1e-3")
    )
    assert [engine.tolerances for engine in given.engines] == [{"tol": 1e-5}, {"rtol": 1e-3, "atol": 1e-5}]
    assert [engine.picked_for for engine in given.engines] == [None, "statistics"]
    assert given.hash != picked.hash  # the dataset says which was picked


def test_members_are_counted_without_expanding(scene, source):
    assert scene.n_members == 2 * 3 * 3 * (1 + 2) == len(expand(scene))
    plain = parse_scene(edit(source, "[perturbation]\nsizes = [0.05, 0.01]", ""))
    assert plain.n_members == 2 * 3 * 1 * (1 + 2) == len(expand(plain))


def test_a_scene_of_many_members_is_run_if_the_user_says_yes(tmp_path, source):
    """It is read and counted without a list of members."""
    large = parse_scene(edit(source, "matrices = 3", "matrices = 1000000000"))
    assert len(expand(large)) == large.n_members > 1e9
    large.check_size(yes=True)
    with pytest.raises(SceneError, match=f"at most 10000000 members, got {large.n_members} .*`matrices`.* --yes"):
        run_ensemble(large, tmp_path / "out", workers=0)
    assert not [*tmp_path.iterdir()]
