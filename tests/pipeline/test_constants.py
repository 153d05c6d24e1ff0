"""The constants of each member as lists: a system is made again from rows alone."""

import netCDF4
import numpy as np
import pyarrow.dataset as ds
import pytest

from stickslip.pipeline import expand, extend, parse_scene, run_ensemble, verify
from stickslip.pipeline.running import worker
from stickslip.sim import Harmonic, System
from stickslip.workflows import netcdf

SCENE = """
[system]
coupling = "{coupling}"
n = [4, 5]
friction = {{uniform = [0.8, 1.2]}}
static = {{ratio = {{uniform = [1.1, 1.4]}}}}
mass = [1.0, {{uniform = [0.5, 2.0]}}]
{more}
[start]
z = {{uniform = [-0.5, 0.5]}}
w = "belt"
[run]
t_end = 4.0
matrices = 2
[[engine]]
name = "sigmoid"
eps = 0.05
ratio = "uniform"
[twins]
sizes = [1e-3]
{record}
[analysis]
t_burn = 1.0
dt = [1.0]
"""
FORCE = "[system.force]\namplitude = {uniform = [0.1, 0.2]}\nfrequency = 1.0\nphase = 0.5\n"
COURSE = "belt_speed = {times = [0.0, 2.0], values = [-0.1, -0.2]}\nback_slip = false\n"


@pytest.mark.parametrize(
    ("coupling", "more"), [("antisymmetric", FORCE), ("chain", COURSE), ("antisymmetric", COURSE)]
)
def test_a_system_is_made_again_from_its_row(coupling, more, tmp_path, monkeypatch):
    plain = parse_scene(SCENE.format(coupling=coupling, more=more, record=""))
    run_ensemble(plain, tmp_path / "plain", workers=0)

    def run(*_):
        raise AssertionError("runs are not made again")

    monkeypatch.setattr(worker, "_result", run)
    out = tmp_path / "out"
    extend(tmp_path / "plain", {"constants": True}, out, workers=0)
    assert verify(out) == []
    file = tmp_path / "out.nc"
    netcdf.write(out, file)
    with netCDF4.Dataset(file) as written:  # of a null list the file has NaN
        belts, sizes = written["constant_belt_speed"][:].filled(np.nan), written["block_row_size"][:]
    assert len(belts) == sizes.sum()
    assert np.isnan(belts).all() == (more == COURSE)
    rows = {row["member_id"]: row for row in ds.dataset(out / "data").to_table().to_pylist()}
    for member in expand(plain):
        row, system = rows[member.member_id], member.system()
        lists = {key.removeprefix("constant_"): one for key, one in row.items() if "constant_" in key}
        known = {key: np.array(one) for key, one in lists.items() if one is not None}
        stiffness = np.zeros((row["n"], row["n"]))
        stiffness[known["row"], known["column"]] = known["stiffness"]
        wave = [known.get(f"force_{name}") for name in ("amplitude", "frequency", "phase")]
        assert ("belt_speed" in known) == (more == FORCE)
        again = System(
            stiffness, known["damping"], known["friction"], static=known["static"], mass=known["mass"],
            belt_speed=known["belt_speed"] if more == FORCE else system.belt_speed,
            force=Harmonic(*wave) if more == FORCE else None, back_slip=system.back_slip,
        )  # fmt: skip
        times = np.linspace(0.0, 4.0, 5)
        dense = system.stiffness if isinstance(system.stiffness, np.ndarray) else system.stiffness.toarray()
        for mine, theirs in (
            (again.stiffness, dense), (again.damping, system.damping), (again.friction, system.friction),
            (again.static, system.static), (again.mass, system.mass), (known["ratio"], member.ratios()),
            (again.force_at(times), system.force_at(times)),
            (again.belt_speed_at(times), system.belt_speed_at(times)),
            *zip((known["z0"], known["w0"]), member.start(), strict=True),
        ):  # fmt: skip
            np.testing.assert_array_equal(mine, theirs)
