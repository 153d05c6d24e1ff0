"""Every term of the table has its column, its groups and its heading: else a sweep pools its values."""

import pytest

from stickslip.analysis.members import SYSTEM_KEYS
from stickslip.pipeline import expand, parse_scene, query, run_ensemble
from stickslip.sim.engines import ENGINES
from stickslip.sim.systems.system import BEYOND
from stickslip.sim.systems.terms import TERMS
from stickslip.sim.systems.weakening import LAWS
from stickslip.workflows.reporting import study_of


def law_with(law, key):
    """A law of friction, with VALUE for one of its parameters."""
    numbers = {name: said["example"] for name, said in law.parameters().items()} | {key: "VALUE"}
    listed = ", ".join(f"{name} = {number}" for name, number in numbers.items())
    return f'static = 1.3\nweakening = {{law = "{law.name}", {listed}}}'


#: What a scene says beside a term, where a chain of blocks without static friction does not do.
BESIDE = {
    "degree": 'coupling = "network"',
    "rewiring": 'coupling = "small_world"',
    "rho": 'coupling = "full"',
    "force_amplitude": "force = {frequency = 1.0, amplitude = VALUE}",
    "force_frequency": "force = {amplitude = 0.5, frequency = VALUE}",
    "force_phase": "force = {amplitude = 0.5, frequency = 1.0, phase = VALUE}",
    "static": "friction = 0.5\nstatic = VALUE",
    "drive_spring": "leaf = 0.0\ndrive = {block = 0, speed = 0.1, spring = VALUE}",
    "drive_speed": "leaf = 0.0\ndrive = {block = 0, spring = 2.0, speed = VALUE}",
    "drive_amplitude": "leaf = 0.0\ndrive = {block = 0, spring = 2.0, speed = 0.1, amplitude = VALUE}",
    "drive_frequency": "leaf = 0.0\ndrive = {block = 0, spring = 2.0, speed = 0.1, frequency = VALUE}",
    "drive_phase": "leaf = 0.0\ndrive = {block = 0, spring = 2.0, speed = 0.1, phase = VALUE}",
    "rayleigh_mass": "rayleigh = {mass = VALUE}",
    "rayleigh_stiffness": "rayleigh = {stiffness = VALUE}",
} | {f"weakening_{key}": law_with(law, key) for law in LAWS.values() for key in law.parameters()}


def engine_that_takes(term):
    """The first engine that runs a term and what `BESIDE` says with it."""
    part = "force" if term.part == "drive" else term.part
    beyond = {*BEYOND} & {term.name, part, *("static",) * ("static" in BESIDE.get(term.name, ""))}
    return next(name for name, engine in ENGINES.items() if beyond <= engine.taken())


def scene(term, value):
    beside = BESIDE.get(term.name, "")
    lines = beside if "VALUE" in beside else f"{beside}\n{term.key} = VALUE"
    coupling = "" if "coupling" in lines else 'coupling = "chain"\n'
    return parse_scene(
        f"[system]\n{coupling}n = 5\n{lines.replace('VALUE', value)}\n"
        '[start]\nz = 0.1\nw = "belt"\n[run]\nt_end = 4.0\nmatrices = 2\npurpose = "statistics"\n'
        f'[[engine]]\nname = "{engine_that_takes(term)}"\n'
        "[analysis]\nt_burn = 1.0\ndt = [0.5]\n".encode()
    )


@pytest.mark.parametrize("term", TERMS, ids=lambda term: term.name)
def test_a_swept_term_has_its_column_its_ids_and_its_groups(term, tmp_path):
    swept = scene(term, "[0.7, 0.9]")
    members = expand(swept)
    assert [member.term(term.name) for member in members] == [0.7, 0.9] * 2
    assert all(f"-{term.name}=" in member.member_id for member in members)
    run_ensemble(swept, tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out")
    assert table[term.name].tolist() == [0.7, 0.9] * 2
    assert query.table(tmp_path / "out").schema.field(term.name).metadata[b"description"].decode() == term.described
    groups = study_of(str(tmp_path / "out")).groups
    assert {group.key[term.name] for group in groups} == {0.7, 0.9}
    assert term.name in SYSTEM_KEYS


@pytest.mark.parametrize("term", [term for term in TERMS if term.draws], ids=lambda term: term.name)
def test_a_drawn_term_has_numbers_of_its_own_for_each_block(term):
    """By a purpose of its own: no two terms share their draws."""
    (first, _), drawn = expand(scene(term, "{uniform = [0.7, 0.9]}")), {}
    for other in TERMS:
        if other.draws and other.name != term.name:
            (same, _) = expand(scene(other, "{uniform = [0.7, 0.9]}"))
            drawn[other.name] = same.term(other.name).draw(same._seed(other.purpose), 5).tolist()
    assert first.row()[term.name] is None
    assert f"{term.name} = uniform(0.7, 0.9)" in first.drawn
    assert first.term(term.name).draw(first._seed(term.purpose), 5).tolist() not in drawn.values()
