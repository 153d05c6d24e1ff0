"""Scenes as measured: runs are those of the system made by hand, of an own integration, and of any other units."""

import json
import re

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.sparse import csc_array

from stickslip import Dataset, Scene, System, simulate
from stickslip.pipeline import SceneError, expand, extend, load_scene, query, run_ensemble
from stickslip.pipeline.design.units import DIMENSIONS, Units
from stickslip.sim.systems.scales import Scales
from tests.pipeline.drill import bit_events

SI = {"time": "s", "angle": "rad", "inertia": "kg m^2"}
NAMES = ["table", *(f"pipe{k}" for k in range(1, 19)), "bit"]


def drill(speed=2.0, t_end=20.0, **tables):
    """A drill string of 20 inertias in SI units, with damping against the mud and within the pipe."""
    return Scene(
        units=SI,
        system={
            "coupling": "chain", "n": 20, "names": NAMES, "contacts": ["bit"], "kappa": 9000.0, "leaf": 0.0,
            "mass": 20.0, "rayleigh": [0.1, 0.005], "friction": 6000.0, "static": 9000.0,
            "drive": {"block": "table", "spring": 9000.0, "speed": speed},
        },
        start="rest",
        run={"t_end": t_end, "matrices": 1},
        engine=[{"name": "coulomb", "tol": 1e-12}],
        record={"events": True} | tables.pop("record", {}),
        analysis={"t_burn": 5.0, "dt": 0.1},
        **tables,
    )  # fmt: skip


def by_hand():
    """Stiffness, damping, mass and friction of the string, in SI units."""
    laplacian = np.diag([1.0, *[2.0] * 18, 1.0]) - np.eye(20, k=1) - np.eye(20, k=-1)
    bit = np.arange(20) == 19
    stiffness, mass = 9000.0 * laplacian, np.full(20, 20.0)
    return stiffness, np.diag(0.1 * mass) + 0.005 * stiffness, mass, bit


def test_a_drill_string_is_that_made_by_hand_and_that_of_an_own_integration_in_si_units(tmp_path):
    scene = drill()
    run_ensemble(scene, tmp_path / "out", workers=0)
    events = query.events(tmp_path / "out", next(iter(expand(scene))).member_id)
    stiffness, damping, mass, bit = by_hand()
    string = System(csc_array(stiffness), csc_array(damping), 6000.0 * bit, 0.0, 9000.0 * bit, mass=mass)
    scales = scene.scales
    system = scales.dimensionless(string.driven(0, spring=9000.0, speed=2.0, damping=0.005 * 9000.0))
    run = simulate(system, 0.0, "belt", 20.0 / scales.time, tol=1e-12)
    assert (run.events.t * scales.time).tobytes() == events.t.tobytes()
    assert run.events.block.tobytes() == events.block.tobytes()
    drive = (0, 9000.0, 0.005 * 9000.0, lambda t: 2.0 * t, lambda t: 2.0)
    expected = bit_events(stiffness, damping, mass, 6000.0, drive, 19, 2.0, 20.0, static=9000.0)
    of_bit = events.block == 19
    assert len(expected) >= 4
    assert [mode for _, mode in expected] == events.mode[of_bit].tolist()
    np.testing.assert_allclose([t for t, _ in expected], events.t[of_bit], rtol=0, atol=1e-8)


def test_scales_are_powers_of_two_near_those_of_the_first_system():
    scene = drill(speed=[2.0, 4.0])
    stiffness, _, mass, bit = by_hand()
    near = Scales.of(System(stiffness, 0.0, 6000.0 * bit, mass=mass))
    for name in ("length", "time", "force"):
        scale = getattr(scene.scales, name)
        assert np.log2(scale) == round(np.log2(scale))
        assert 0.7 < scale / getattr(near, name) < 1.42
    assert [member.row()["drive_speed"] for member in expand(scene)] == [2.0, 4.0]  # as they were written
    assert scene.changed(system={"friction": 100.0}).scales == scene.scales  # runs stay comparable


def moving(units, factor, tmp_path):
    """The page and the members of some blocks on a belt, measured in units of which SI's are so many."""
    t, x, m = factor
    scene = Scene(
        title="blocks",
        units=units,
        system={
            "coupling": "chain", "n": 3, "names": ["a", "b", "c"], "kappa": 2e5 * m / t**2, "leaf": 1e5 * m / t**2,
            "mass": {"uniform": [1.0 * m, 2.0 * m]}, "damping": 20.0 * m / t, "friction": 300.0 * m * x / t**2,
            "static": {"ratio": 1.4}, "belt_speed": [-0.1 * x / t, -0.3 * x / t],
            "weakening": {"law": "stribeck", "speed": 0.5 * x / t},
            "force": {"amplitude": 20.0 * m * x / t**2, "frequency": 100.0 / t, "blocks": ["b"]},
        },
        start={"z": {"uniform": [-1e-3 * x, 1e-3 * x]}, "w": 0.0, "draws": 4},
        run={"t_end": 0.4 * t, "matrices": 1},
        engine=[{"name": "coulomb", "tol": 1e-13}],
        record={
            "events": True, "amplitude": True, "slip_speed": ["a"], "attractor": True, "first_exit": True,
            "end": True, "energy": True, "waiting": True, "dt": 5e-4 * t,
        },
        analysis={"t_burn": 0.1 * t, "dt": 1e-3 * t, "question": ["changes", "fates", "cascades", "one_run"]},
    )  # fmt: skip
    run_ensemble(scene, tmp_path, workers=0)
    Dataset(tmp_path).report()
    return Dataset(tmp_path), json.loads((tmp_path / "report" / "findings.json").read_text())


def bare(sentence, units):
    """A sentence without its units and numbers."""
    for unit in sorted({units.of(dimension) for dimension in DIMENSIONS}, key=len, reverse=True):
        sentence = re.sub(rf"(?<=[\d)]) {re.escape(unit)}(?![\w/^])", "", sentence)
    return re.sub(r"[+−]?[\d.,]*\d( × 10[⁻⁰-⁹²³¹]+)?", "#", sentence)


def test_other_units_give_the_same_motion_and_say_the_same(tmp_path):
    si, said = moving({"time": "s", "length": "m", "mass": "kg"}, (1.0, 1.0, 1.0), tmp_path / "si")
    small, said_small = moving({"time": "ms", "length": "mm", "mass": "g"}, (1e3, 1e3, 1e3), tmp_path / "small")
    by = {
        "t_end": 1e3, "first_exit": 1e3, "waiting_mean": 1e3, "amplitude": 1e3, "slip_speed_a": 1.0,
        "kinetic_energy_end": 1e3, "friction_loss": 1e3, "n_exits": 1.0,
    }  # fmt: skip
    tables = [dataset.members for dataset in (si, small)]
    for name, factor in by.items():
        columns = [table[name].to_numpy(float, na_value=np.nan) for table in tables]
        np.testing.assert_allclose(columns[0] * factor, columns[1], rtol=1e-9, err_msg=name)
    for member, other in zip(*(table["member_id"] for table in tables), strict=True):
        runs = si.events(member), small.events(other)
        assert len(runs[0]) > 20
        np.testing.assert_allclose(1e3 * runs[0].t, runs[1].t, rtol=0, atol=1e-12 * 400.0)
        assert runs[0].mode.tobytes() == runs[1].mode.tobytes()
    assert [runs.unit for runs in runs] == ["s", "ms"]
    without = [
        [bare(finding["sentence"], units) for finding in page["findings"]]
        for page, units in ((said, Units("s", "m", "kg")), (said_small, Units("ms", "mm", "g")))
    ]
    assert without[0] == without[1]
    sentences = " ".join(f["sentence"] for f in said["findings"])
    assert " m " in sentences or " m/s" in sentences
    units = {row["quantity"]: row.get("measured_in") for f in said["findings"] for row in f["rows"]}
    assert units["mean amplitude of the block that swings most"] == "m"
    assert units["mean slip speed of a"] == "m/s"


def test_files_have_numbers_their_scales_and_units_and_readers_the_units(tmp_path):
    scene = drill(speed=[2.0, 4.0], record={"amplitude": ["bit"], "dt": 0.01})
    run_ensemble(scene, tmp_path / "out", workers=0)
    stored, table = pq.read_table(tmp_path / "out" / "data"), query.table(tmp_path / "out")
    dimensions = {
        "amplitude_bit": "rad", "t": "s", "event_t": "s", "t_end": "s", "t_stop": "s", "drive_speed": "rad/s",
        "friction": "N m", "kappa": "N m/rad", "rayleigh_stiffness": "s", "mass": "kg m^2",
    }  # fmt: skip
    for name, unit in dimensions.items():
        about = stored.schema.field(name).metadata
        assert about[b"unit"].decode() == unit
        scale, column = float(about[b"scale"]), table[name].combine_chunks()
        values = [x.values if name in ("t", "event_t") else x for x in (stored[name].combine_chunks(), column)]
        assert np.array_equal(values[0].to_numpy() * scale, values[1].to_numpy())
    assert b"unit" not in stored.schema.field("n_exits").metadata
    rows = query.members(tmp_path / "out", ["drive_speed", "t_end", "amplitude_bit"])
    assert rows["drive_speed"].tolist() == [2.0, 4.0]
    assert rows["t_end"].tolist() == [20.0, 20.0]
    assert query.sql(tmp_path / "out", "SELECT drive_speed, t_end, amplitude_bit FROM members").equals(rows)
    times = query.sql(tmp_path / "out", "SELECT max(t) AS t FROM events")["t"][0]
    names = query.members(tmp_path / "out")["member_id"]
    assert times == max(query.events(tmp_path / "out", name).t[-1] for name in names)
    low, high = sorted(rows["amplitude_bit"])
    kept = query.members(tmp_path / "out", ["amplitude_bit"], [("amplitude_bit", ">", (low + high) / 2)])
    assert kept["amplitude_bit"].tolist() == [high]
    plain = {"member_id", "outcome"}
    assert {field.name for field in stored.schema if b"unit" not in field.metadata} >= plain


def test_ends_and_extensions_are_in_the_same_scales(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = drill(record={"end": True})
    run_ensemble(first, "first", workers=0)
    whole = drill(record={"end": True, "stick_share": ["bit"], "attractor": True})
    run_ensemble(whole, "whole", workers=0)
    extend("first", {"stick_share": ["bit"], "attractor": True}, "more", workers=0)
    shards = [next((tmp_path / name / "data").glob("*.parquet")).read_bytes() for name in ("whole", "more")]
    assert shards[0] == shards[1]
    tables = first.model_dump(mode="json", by_alias=True, exclude_unset=True)
    on = Scene(**tables | {"start": {"dataset": "first"}})
    run_ensemble(on, "on", workers=0)
    ended = query.table("first")["z_end"][0].values.to_numpy()
    (member,) = expand(on)
    from stickslip.pipeline.running.ends import end_of

    z, _ = member.start(end_of(member))
    assert np.array_equal(z * on.scales.length, ended)
    other = {"time": "ms", "angle": "rad", "inertia": "kg m^2"}
    with pytest.raises(SceneError, match=r"start.dataset: expected a dataset in the units of the scene"):
        run_ensemble(Scene(**tables | {"units": other, "start": {"dataset": "first"}}), "off", workers=0)


def test_files_and_functions_are_in_the_units_of_their_scene(tmp_path):
    stiffness = 3e5 * np.eye(2) - 1e5
    np.savez(tmp_path / "K.npz", stiffness=stiffness, mass=[0.8, 1.2], friction=[200.0, 280.0], z0=[1e-3, -1e-3])
    (tmp_path / "own.py").write_text(
        "import numpy as np\nfrom stickslip import System\n\n\ndef draw(n, rng):\n    return System(\n        "
        "3e5 * np.eye(2) - 1e5, 5.0, [200.0, 280.0], mass=[0.8, 1.2], belt_speed=-0.3\n    )\n"
    )
    rest = (
        'units = {time = "s", length = "m", mass = "kg"}\n[start]\nz = %s\nw = "belt"\n[run]\nt_end = 0.2\n'
        'matrices = 1\n[[engine]]\nname = "coulomb"\ntol = 1e-10\n[analysis]\nt_burn = 0.05\ndt = 1e-3\n'
    )
    events = []
    for source, z in (
        ('coupling = "file", path = "K.npz", damping = 5.0, belt_speed = -0.3', '"file"'),
        ('coupling = "own:draw", n = 2', "0.0"),
    ):
        (tmp_path / "scene.toml").write_text(f"system = {{{source}}}\n{rest % z}")
        scene = load_scene(tmp_path / "scene.toml")
        (member,) = expand(scene)
        start = member.start()[0]
        system, scales = System.from_physical(
            stiffness, 5.0, [200.0, 280.0], -0.3, mass=[0.8, 1.2], scales=scene.scales
        )
        assert np.array_equal(start, np.array([1e-3, -1e-3]) / scales.length if z == '"file"' else 0.0)
        run, hand = member.simulate(), simulate(system, start, "belt", 0.2 / scales.time)
        assert run.events.t.tobytes() == hand.events.t.tobytes()
        events.append(len(run.events))
        assert scene.scales.force == 256.0  # the power of two nearest to 240 N
    assert min(events) > 1


@pytest.mark.parametrize(("units", "why"), [
    ({"time": "s"}, "length: expected either `length` or `angle`, got neither"),
    ({"time": "s", "length": "m"}, "mass: expected either `mass` or `inertia`, got neither"),
    ({"time": "s", "length": "m", "angle": "rad", "mass": "kg"}, "got both"),
    ({"time": "s", "length": "m", "inertia": "kg m^2"}, "got a mixture"),
    ({"length": "m", "mass": "kg"}, "units.time"),
    ({"time": "sec", "length": "m", "mass": "kg"}, "units.time: expected 's', 'ms'"),
    ({"time": "s", "length": "furlong", "mass": "kg"}, "units.length"),
    ({"time": "s", "length": "m", "mass": "lb"}, "units.mass"),
    ({"time": "s", "length": "m", "mass": "kg", "force": "kN"}, "unknown key"),
    ({"time": 1.0, "length": "m", "mass": "kg"}, "units.time"),
    (SI | {"scales": {"length": 1.0, "time": 0.0, "force": 1.0}}, "greater than 0"),
    (SI | {"scales": {"length": 1e300, "time": 1.0, "force": 1.0}}, "units.scales.length: expected a scale from"),
    ({"time": "s", "length": "m", "mass": "kg", "scales": {"length": 1.0}}, "units.scales.time"),
    ("SI", "units"),
])  # fmt: skip
def test_units_that_are_none_are_refused(units, why):
    with pytest.raises(SceneError) as error:
        drill().changed(units=units)
    assert why in str(error.value)


def test_a_scene_without_anything_to_scale_by_says_so():
    with pytest.raises(SceneError, match=r"units: friction: expected a mean friction above 0"):
        drill().changed(units=SI, system={"friction": 0.0, "static": None})
    scaled = SI | {"scales": {"length": 0.5, "time": 0.25, "force": 64.0}}
    assert drill().changed(units=scaled, system={"friction": 0.0, "static": None}).scales == Scales(0.5, 0.25, 64.0)


def test_units_of_dimensions():
    assert Units("s", "m", "kg").of("damping") == "N s/m"
    assert Units("s", "rad", "kg m^2").of("stiffness") == "N m/rad"
    assert Units("ms", "mm", "g").of("force") == "g mm/ms^2"
    assert Units("ms", "mm", "g").of("frequency") == "1/ms"
    assert Units("ms", "rad", "kg m^2").of("energy") == "kg m^2 rad^2/ms^2"
    assert Units().of("force") == ""
    assert Units("s", "m", "kg").label("time t", "time") == "time t (s)"


def shaken(tmp_path, t_end=8.0, load=None, **record):
    """Three equal blocks of 2 kg on 400 N/m each, in SI units, on a belt that is slow, and on one that is fast."""
    scene = Scene(
        system={"coupling": "chain", "n": 3, "kappa": 400.0, "leaf": 400.0, "mass": 2.0, "friction": 40.0,
                "static": 50.0, "damping": 10.0, "belt_speed": -0.1 if load else [-0.1, -30.0]},
        units={"time": "s", "length": "m", "mass": "kg"},
        start="rest",
        run={"t_end": t_end, "matrices": 1} | ({} if load is None else {"load": load}),
        engine={"name": "coulomb", "tol": 1e-9},
        record={"episodes": True} | record,
        analysis={"t_burn": 1.0, "dt": 0.1},
    )  # fmt: skip
    assert scene.scales.time != 1.0
    run_ensemble(scene, tmp_path / "out", workers=0)
    return tmp_path / "out"


def test_times_of_all_records_are_in_one_unit(tmp_path):
    """A cluster of all blocks is the episode; what settles into steady sliding at t_stop collapsed then."""
    out = shaken(tmp_path, clusters=True, collapse=True)
    episodes, clusters = query.episodes(out), query.clusters(out)
    assert len(clusters) == len(episodes) > 5
    assert (clusters["size"] == 3).all()
    np.testing.assert_array_equal(clusters[["start", "end"]], episodes[["start", "end"]])
    assert 0.1 < np.diff(episodes["start"]).min() < episodes["end"].max() < 8.0
    collapsed = query.members(out).query("outcome == 'collapsed'")
    assert len(collapsed) == 1
    assert (collapsed["t_collapse"] == collapsed["t_stop"]).all()
    assert 50.0 / (400.0 * 30.0) <= collapsed["t_collapse"].item() < 8.0  # it is let go before


def test_an_episode_under_a_belt_that_waits_takes_half_a_period(tmp_path):
    """All three go together: w'' = -k / m z - R / m w, over pi / (k / m - (R / 2 m)^2)^(1/2)."""
    elapsed = query.episodes(shaken(tmp_path, load="adiabatic"))["elapsed"]
    np.testing.assert_allclose(elapsed, np.pi / np.sqrt(200.0 - 2.5**2), rtol=1e-7)


def test_further_definitions_of_sticking_are_in_the_same_units_by_sql_and_as_arrays(tmp_path):
    scene = Scene(
        system={"coupling": "chain", "n": 3, "kappa": 400.0, "leaf": 400.0, "mass": 2.0, "friction": 40.0,
                "static": 40.0, "damping": 1.0, "belt_speed": -0.1},
        units={"time": "s", "length": "m", "mass": "kg"},
        start="rest",
        run={"t_end": 4.0, "matrices": 1},
        engine={"name": "sigmoid", "eps": 0.03, "thresholds": [0.5, 2.0], "stick": "threshold"},
        analysis={"t_burn": 1.0, "dt": 0.1},
    )  # fmt: skip
    assert scene.scales.time != 1.0
    run_ensemble(scene, tmp_path / "out", workers=0)
    ((_, series),) = query.by_threshold(tmp_path / "out").items()
    rows = query.sql(tmp_path / "out", "SELECT * FROM thresholds")
    for threshold, (t, _) in series.items():
        assert rows["t"][rows["threshold"] == threshold].tolist() == t.tolist()
    assert 1.0 < rows["t"].max() <= 4.0
