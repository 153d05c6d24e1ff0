"""Run beside a package with guests: each with all that there is in the other tables, from a scene to its exports.

Called with a folder to write to, a seed and what names begin with: runs the guests among these and two others that
the seed picks, all if there is none; prints a line for each, and what it raised.
"""

import random
import sys
import traceback
from pathlib import Path

import matplotlib

from stickslip.analysis.questions import QUESTIONS
from stickslip.pipeline import parse_scene, query, run_ensemble
from stickslip.pipeline.records import RECORDS
from stickslip.pipeline.records.record import StateRecord
from stickslip.sim.engines import ENGINES
from stickslip.sim.systems.couplings import COUPLINGS
from stickslip.sim.systems.graphs import GRAPHS
from stickslip.sim.systems.system import BEYOND
from stickslip.sim.systems.terms import TERMS
from stickslip.sim.systems.weakening import LAWS
from stickslip.workflows import netcdf, reporting
from tests.workflows.test_terms import BESIDE

#: What a scene asks for by a key under [record], and all of these at once.
KEPT = [record.name for record in RECORDS if record.words and not (record.is_step or record.is_named)]
ALL = "\n".join(["[record]", *(f"{name} = true" for name in KEPT), "separation = 0.5\ndt = 0.1"])
TWINS = "[twins]\nsizes = [1e-3]"
OF_ENGINE = {
    "moreau": "step = 0.05",
    "fixed_step": "step = 0.02",
    "sigmoid": "thresholds = [0.5]",
    "second": "accuracy = 1e-8",
    "a_soft": "softness = 0.1",
}
ASKED = ", ".join(f'"{name}"' for name in QUESTIONS)


def taking(*terms: str) -> list[str]:
    """The engines that take some of what eq. (10) does not have."""
    beyond = {*terms} & {*BEYOND}
    return [name for name, engine in ENGINES.items() if beyond <= engine.taken()]


def scene(system: str, engines: list[str], *tables: str, coupling: str = "chain") -> str:
    tables_of = (f'[[engine]]\nname = "{name}"\n{OF_ENGINE.get(name, "")}' for name in engines)
    lines = f'coupling = "{coupling}"\n' * ("coupling" not in system) + system
    if not all(ENGINES[name].keeps_stills for name in engines):
        for record in (record for record in RECORDS if record.needs_stills):
            tables = tuple(table.replace(f"{record.name} = true\n", "") for table in tables)
    return "\n".join([
        f"[system]\n{lines}\nn = 5", '[start]\nz = {uniform = [-0.5, 0.5]}\nw = "belt"',
        "[run]\nt_end = 12.0\nmatrices = 4", *tables_of, *tables,
        f"[analysis]\nt_burn = 3.0\ndt = [0.5]\nresamples = 10\nquestion = [{ASKED}]",
    ])  # fmt: skip


def term_scene(name: str, value: str = "[0.7, 0.9]") -> str:
    """One that sweeps a term, under the engines that take it."""
    term = next(term for term in TERMS if term.name == name)
    beside = BESIDE.get(name, "")
    lines = beside if "VALUE" in beside else f"{beside}\n{term.key} = VALUE"
    static = ("static",) if "static" in lines else ()
    beyond = {"drive": "force", "rayleigh": "damping matrix"}.get(term.part, term.part or name)
    return scene(lines.replace("VALUE", value), taking(beyond, *static))


def law_scene(name: str) -> str:
    parameters = ", ".join(f"{key} = {said['example']}" for key, said in LAWS[name].parameters().items())
    system = f'static = 1.3\nweakening = {{law = "{name}", {parameters}}}'
    return scene(system, taking("weakening", "static"), TWINS, ALL)


def scenes() -> dict[str, str]:
    """By what it is about: each entry of a table with all entries of the others that it can be run with."""
    plain = taking()
    couplings = {f"coupling {name}": scene("", plain, TWINS, ALL, coupling=name) for name in (*COUPLINGS, *GRAPHS)}
    laws = {f"law {name}": law_scene(name) for name in LAWS}
    terms = {f"term {term.name}": term_scene(term.name) for term in TERMS}
    records = {
        f"record {record.name}": scene(
            "",
            [name for name in plain if ENGINES[name].keeps_stills or not record.needs_stills],
            f"[record]\n{record.name} = true" + "\ndt = 0.1" * issubclass(record, StateRecord),
        )
        for record in RECORDS
        if record.name in KEPT
    }
    return couplings | laws | terms | records


def through(text: str, out: Path) -> None:
    """A scene to a dataset, its report with every question, a query, an export and a comparison with itself."""
    swept = parse_scene(text)
    run_ensemble(swept, out, workers=0)
    table = query.members(out)
    failed = table[table.outcome == "failed"]
    assert failed.empty, failed.reason.iloc[0]
    assert {*table.engine} == {engine.name for engine in swept.engines}
    for record in swept.records:
        for column in record.kept:
            if record.is_of_exact and column.name in table:
                exact = table.engine.map(lambda name: ENGINES[name].is_exact)
                assert table[column.name][~exact].isna().all(), column.name
    reporting.write(reporting.report(out), out)
    assert len(query.sql(out, "SELECT * FROM members")) == len(table)
    netcdf.write(out, out.with_suffix(".nc"))
    reporting.compared(out, out)


#: By the guide, and by `test_guests.py`.
GUESTS = ("coupling row", "law lorentz", "term drag", "record largest")


def main(folder: Path, seed: int | None, begin: str) -> int:
    from stickslip.analysis.page import comparison, parts

    matplotlib.use("agg")
    n_failed, known = 0, scenes()
    asked = [name for name in known if name.startswith(begin)]
    if seed is not None:
        others = [name for name in asked if name not in GUESTS]
        asked = [name for name in asked if name in GUESTS] + random.Random(seed).sample(others, 2)
    for k, name in enumerate(asked):
        if k:  # figures are drawn of the first
            parts.draw = comparison.draw = lambda *_, **__: parts.Drawn("<svg/>")
        try:
            through(known[name], folder / f"{k}")
            print(f"{name}: done")
        except Exception:  # noqa: BLE001  each is told, and the others are run
            n_failed += 1
            print(f"{name}: {traceback.format_exc()}")
    return n_failed


if __name__ == "__main__":
    place, number, begins = sys.argv[1:]
    sys.exit(main(Path(place), int(number) if number else None, begins))
