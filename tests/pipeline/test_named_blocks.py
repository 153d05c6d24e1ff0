"""Blocks by name: what names may be, and that keys, records, queries and pictures call blocks by them."""

import numpy as np
import pytest

from stickslip import Scene, System, simulate
from stickslip.pipeline import SceneError, expand, load_scene, query, run_ensemble
from stickslip.sim.runs.blocks import named

NAMES = ["table", "pipe", "bit"]


def scene(system=(), record=(), **tables):
    return Scene(
        system={"coupling": "chain", "n": 3, "kappa": 1.0, "leaf": 0.5, "damping": 0.05, "names": NAMES}
        | dict(system),
        start=tables.get("start", {"z": 0.0, "w": "belt"}),
        run={"t_end": 40.0, "matrices": 1},
        engine=[{"name": "coulomb"}],
        record={"dt": 0.05} | dict(record) if record else {},
        analysis={"t_burn": 10.0, "dt": 0.5},
    )


def test_a_record_of_named_blocks_is_that_of_their_runs(tmp_path):
    asked = {"amplitude": ["bit", "table"], "slip_speed": "bit", "stick_share": ["bit"], "events": True}
    run_ensemble(scene(record=asked), tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out")
    (row,) = table.to_dict("records")
    assert not {"amplitude", "slip_speed", "never_slipped"} & {*table}
    times = np.linspace(10.0, 40.0, 300_001)
    (member,) = expand(scene(record=asked))
    run = member.simulate(times)
    system, bit = member.system(), 2
    for name, block in (("bit", 2), ("table", 0)):
        assert system.block(name) == block
        assert row[f"amplitude_{name}"] == pytest.approx(np.ptp(run.samples.z[:, block]) / 2, abs=1e-6)
    slip = np.abs(run.samples.w[:, bit] - system.belt_speed)
    assert row["slip_speed_bit"] == pytest.approx(slip.mean(), abs=1e-3)
    sticks = np.mean([mode[bit] == 0 for mode in run.events.modes_at(times)])
    assert row["stick_share_bit"] == pytest.approx(sticks, abs=1e-4)
    series = query.events(tmp_path / "out", row["member_id"])
    assert series.names == run.events.names == tuple(NAMES)
    counts = query.sql(
        tmp_path / "out", "SELECT name, count(*) AS n FROM events JOIN blocks USING (block) GROUP BY 1"
    )
    assert dict(zip(counts["name"], counts["n"], strict=True)) == {
        name: n for name, n in zip(NAMES, np.bincount(series.block, minlength=3), strict=True) if n
    }


def test_names_change_no_number_and_a_force_may_act_on_one():
    plain, named = (scene(system={"names": names}) for names in (None, NAMES))
    runs = [next(iter(expand(one))).simulate() for one in (plain, named)]
    assert runs[0].events.t.tobytes() == runs[1].events.t.tobytes()
    force = {"amplitude": 0.3, "frequency": 1.0}
    by_name, by_number = (scene(system={"force": force | {"blocks": [block]}}) for block in ("bit", 2))
    assert by_name.hash == by_number.hash


def test_names_of_files_and_functions_are_those_of_the_scene(tmp_path):
    stiffness = 2.0 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1)
    np.savez(tmp_path / "K.npz", stiffness=stiffness, names=NAMES)
    (tmp_path / "own.py").write_text(
        "import numpy as np\nfrom stickslip import System\n\n\n"
        f"def draw(n, rng):\n    return System(np.eye(n), 0.1, names={NAMES})\n"
    )
    rest = (
        'start = "rest"\n[run]\nt_end = 5.0\nmatrices = 1\n[[engine]]\nname = "coulomb"\n'
        '[record]\nstick_share = "bit"\n[analysis]\nt_burn = 1.0\ndt = 0.5\n'
    )
    for source in ('coupling = "file", path = "K.npz", rho = 3.5', 'coupling = "own:draw", n = 3'):
        (tmp_path / "scene.toml").write_text(f"system = {{{source}}}\n{rest}")
        loaded = load_scene(tmp_path / "scene.toml")
        assert loaded.system.block_names == tuple(NAMES)
        assert next(iter(expand(loaded))).system().names == tuple(NAMES)


@pytest.mark.parametrize(("system", "record", "why"), [
    ({"names": ["a", "b"]}, {}, "one for each of 3 blocks, got 2"),
    ({"names": ["a", "b", "A"]}, {}, "each once, whatever its case"),
    ({"names": ["a", "b", "x'; DROP TABLE members --"]}, {}, "a letter, then letters, digits and _"),
    ({"names": ["a", "b", "2nd"]}, {}, "rename that block"),
    ({"names": ["a", "b", "c" * 41]}, {}, "40 at most"),
    ({"names": ["a", "b", "c" * 100_000]}, {}, "40 at most"),
    ({}, {"amplitude": ["c" * 100_000]}, "one of table"),
    ({"names": ["a", "b", 3]}, {}, "string"),
    ({"n": [3, 4]}, {}, "one for each of 4 blocks, got 3"),
    ({}, {"amplitude": ["bite"]}, "did you mean 'bit'?"),
    ({}, {"amplitude": []}, "names of blocks"),
    ({}, {"amplitude": ["bit", "bit"]}, "each value once"),
    ({"names": None}, {"amplitude": ["bit"]}, "have no names"),
    ({"names": ["a", "b", "mean"]}, {"amplitude": ["mean"]}, "a column of the data has it"),
    ({"force": {"amplitude": 1.0, "frequency": 1.0, "blocks": ["top"]}}, {}, "force.blocks: expected one of table"),
    ({"force": {"amplitude": 1.0, "frequency": 1.0, "blocks": ["bit", 2]}}, {}, "each block once"),
])  # fmt: skip
def test_names_that_are_no_names_are_refused(system, record, why):
    with pytest.raises(SceneError, match=r"names|amplitude|blocks") as error:
        scene(system=system, record=record)
    assert why in str(error.value)
    assert len(str(error.value)) < 300


def test_many_names_are_read_in_one_pass():  # each beside all others would take a quarter of an hour
    names = [f"b{k}" for k in range(200_000)]
    assert named(names, len(names)) == tuple(names)


def test_pictures_call_blocks_by_name():
    import matplotlib.pyplot as plt

    system = System(np.eye(3) + 0.1, 0.1, names=NAMES)
    run = simulate(system, 0.0, "belt", 20.0, t_eval=np.linspace(0.0, 20.0, 201))
    assert run.plot("phase", block="bit").get_xlabel() == "displacement z of bit"
    ax = run.plot("time", blocks=["bit", 0])
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["bit", "table", "sticks"]
    assert [text.get_text() for text in run.plot("space_time").get_yticklabels()] == NAMES
    with pytest.raises(ValueError, match="block: expected one of table, pipe, bit, got 'bat'"):
        run.plot("phase", block="bat")
    plt.close("all")
    some = run.events.of_blocks(np.array([True, False, True]))
    assert some.names == ("table", "bit")
    assert system.changed(damping=0.2).names == tuple(NAMES)
