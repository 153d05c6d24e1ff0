"""A stranger's entry in each table, as the guide says to add it, runs with all entries of the other tables."""

import os
import re
import shutil
from functools import partial
from pathlib import Path

import pytest

from stickslip.pipeline import parse_scene, run_ensemble
from tests.processes import python
from tests.scenes import own_law
from tests.workflows.test_docs import ROOT, blocks, page

#: What ships, under other names: an exact engine, and a smoothed law with a setting for its width.
OTHERS = '''"""Engines with settings of their own."""

from dataclasses import dataclass, replace

from stickslip.sim.engines.contract import Engine, Task, setting
from stickslip.sim.engines.coulomb.settings import Coulomb
from stickslip.sim.engines.sigmoid.settings import Sigmoid
from stickslip.sim.engines.tolerances import TOL, WIDTH
from stickslip.sim.runs.run import Run


@dataclass(frozen=True, kw_only=True, eq=False)
class Second(Engine):
    """As `Coulomb`."""

    name = "second"
    about = "exact, by another name."
    is_exact = True
    keeps_stills = True
    takes = Coulomb.takes

    accuracy: float = setting(1e-10, replace(TOL, words="error of a step", in_all=False))

    def integrate(self, task: Task) -> Run:
        return Coulomb(tol=self.accuracy).integrate(task)


@dataclass(frozen=True, kw_only=True, eq=False)
class Soft(Engine):
    """As `Sigmoid`."""

    name = "a_soft"
    about = "smoothed, by another name."
    keeps_stills = True
    takes = Sigmoid.takes

    softness: float = setting(0.05, replace(WIDTH, words="width of the layer", column="", in_all=False))

    def integrate(self, task: Task) -> Run:
        return Sigmoid(eps=self.softness).integrate(task)
'''


def edit(file: Path, *changes: tuple[str, str]) -> None:
    text = file.read_text()
    for old, new in changes:
        assert text.count(old) == 1, (file, old, text.count(old))
        text = text.replace(old, new)
    file.write_text(text)


def add_engines(root: Path) -> None:
    """The guide's own, which takes the guide's term too, and two with settings of their own."""
    engines, drag = root / "sim" / "engines", "- system.drag * np.abs(w) * w - friction])"
    smooth = blocks(page("extending"), "python")[5].replace("- friction])", drag)
    smooth = smooth.replace("    eps: float", '    takes = frozenset({"drag"})\n\n    eps: float')
    (engines / "fixed_step.py").write_text(smooth)
    (engines / "others.py").write_text(OTHERS)
    line = "from stickslip.sim.engines.moreau.settings"
    edit(
        engines / "__init__.py",
        (line, f"from stickslip.sim.engines.fixed_step import FixedStep\n{line}"),
        ("import Moreau\n", "import Moreau\nfrom stickslip.sim.engines.others import Second, Soft\n"),
        ("        Moreau,\n", "        Moreau,\n        FixedStep,\n        Second,\n        Soft,\n"),
    )


def add_term(root: Path) -> None:
    """The guide's row, and its place in `System`."""
    systems = root / "sim" / "systems"
    row = blocks(page("extending"), "python")[0].strip()
    edit(systems / "terms.py", ("\n)\n\n#: The arguments", f"\n    {row},\n)\n\n#: The arguments"))
    force = '        values.update(mass=per_block("mass"'
    drag = '        values.update(drag=per_block("drag", drag, n))\n'
    beyond = (
        '    "drag": Beyond(\n        lambda system: bool(system.drag.any()),\n        "drag", "none, as {} needs",'
        " lambda system: show.span(system.drag),\n    ),\n"
    )
    end = "        names: Sequence[str] = (),\n"
    edit(
        systems / "system.py",
        ("    closed: NDArray[np.int8]\n", "    closed: NDArray[np.int8]\n    drag: Floats\n"),
        (f"{end}    ) -> None:", f"{end}        drag: ArrayLike = 0.0,\n    ) -> None:"),
        (force, drag + force),
        ('            "mass": self.mass,\n', '            "mass": self.mass,\n            "drag": self.drag,\n'),
        ("            mass=1.0,\n", "            mass=1.0,\n            drag=self.drag * share,\n"),
        ("BEYOND = {\n", f"BEYOND = {{\n{beyond}"),
    )


def add_law(root: Path) -> None:
    """The guide's own, as it says to make one known to scenes."""
    folder = root / "sim" / "systems" / "weakening"
    field = "".join(f"    {line}\n" for line in blocks(page("extending"), "python")[-1].splitlines())
    (folder / "lorentz.py").write_text(re.sub(r"    sharpness: float = parameter\(.*\n", field, own_law()))
    line = "from stickslip.sim.systems.weakening.rational"
    edit(
        folder / "__init__.py",
        (line, f"from stickslip.sim.systems.weakening.lorentz import Lorentz\n{line}"),
        ("        Stribeck,\n", "        Stribeck,\n        Lorentz,\n"),
    )


def add_coupling(root: Path) -> None:
    entry = "".join(f"    {line}\n" for line in blocks(page("extending"), "python")[2].splitlines())
    head = "COUPLINGS: dict[str, Coupling] = {\n"
    edit(root / "sim" / "systems" / "couplings.py", (head, head + entry))


def add_record(root: Path) -> None:
    records, line = root / "pipeline" / "records", "from stickslip.pipeline.records.outcome"
    (records / "motion" / "largest.py").write_text(blocks(page("extending"), "python")[1])
    edit(
        records / "__init__.py",
        (line, f"from stickslip.pipeline.records.motion.largest import Largest\n{line}"),
        ("    AttractorRecord,\n", "    AttractorRecord,\n    Largest,\n"),
    )


def add_question(root: Path) -> None:
    analysis = root / "analysis"
    (analysis / "questions" / "slips" / "pauses.py").write_text(blocks(page("extending"), "python")[3])
    edit(analysis / "questions" / "__init__.py", ('"one_run": "runs",', '"one_run": "runs", "pauses": "slips",'))


@pytest.fixture(scope="module")
def house(tmp_path_factory):
    """The package with a guest in every table, and how to run Python there."""
    root = tmp_path_factory.mktemp("house")
    shutil.copytree(ROOT / "stickslip", root / "stickslip", symlinks=True)
    for folder in ("sim", "pipeline", "analysis", "workflows"):
        shutil.copytree(ROOT / folder, root / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for add in (add_engines, add_term, add_law, add_coupling, add_record, add_question):
        add(root)
    shutil.copy(Path(__file__).with_name("guests.py"), root)
    return partial(python, cwd=root, env={**os.environ, "PYTHONPATH": str(ROOT)})


#: A page by the exact engine, and one by the same engine under another name.
TWO_PAGES = """
import sys
from dataclasses import dataclass
from stickslip.sim import engines
from stickslip.sim.engines.coulomb.settings import Coulomb

@dataclass(frozen=True, kw_only=True, eq=False)
class Another(Coulomb):
    name = "another"

engines.ENGINES["another"] = Another

from guests import ALL, TWINS, scene
from stickslip.analysis.page import parts
from stickslip.pipeline import parse_scene, run_ensemble
from stickslip.workflows import reporting
from tests.statements.__main__ import sentences

parts.draw = lambda *_, **__: parts.Drawn("<svg/>")
for name in ("coulomb", "another"):
    text = scene("static = 1.3", [name], TWINS, ALL).replace("t_end = 12.0", "t_end = 60.0")
    run_ensemble(parse_scene(text), f"{sys.argv[1]}/{name}/page", workers=0)
    print(*sentences(reporting.report(f"{sys.argv[1]}/{name}/page").html), "--", sep="\\n")
"""


def test_an_exact_engine_by_another_name_gives_the_same_page(tmp_path):
    """All records and questions but for the name; whatever is of the exact law is of both."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), str(Path(__file__).parent)))}
    done = python("-c", TWO_PAGES, str(tmp_path), env=environment)
    assert done.returncode == 0, done.stderr
    renamed = done.stdout
    for name, other in (("coulomb", "another"), ("exact", "another"), ("Exact", "Another")):
        renamed = renamed.replace(name, other)
    first, second, _ = renamed.split("--\n")
    assert len(first) > 1000
    assert first == second


@pytest.mark.long
@pytest.mark.parametrize("kind", ["coupling", "law", "term", "record"])
def test_all_run_with_all_guests(kind, house, tmp_path, random_seed):
    """The guest and two others of a table, each with the guests of the other tables."""
    done = house("guests.py", str(tmp_path), str(random_seed), kind)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(": done\n") == 3


@pytest.mark.long
def test_what_was_there_before_stays(house, tmp_path):
    """A scene without guests is the same, with the same columns, and its dataset opens, reports and is compared."""
    source = (ROOT / "workflows" / "scenes" / "quick.toml").read_text().replace("n = [20, 100]", "n = 5")
    scene = parse_scene(source)
    (tmp_path / "quick.toml").write_text(source)
    run_ensemble(scene, tmp_path / "out", workers=0)
    columns = [column.name for column in scene.recording.columns]
    show = """
import sys
from stickslip.pipeline import load_scene, query, verify
from stickslip.workflows import reporting
folder = sys.argv[1]
scene = load_scene(f"{folder}/quick.toml")
print(scene.hash, *(column.name for column in scene.recording.columns))
reporting.write(reporting.report(f"{folder}/out"), f"{folder}/out")
reporting.compared(f"{folder}/out", f"{folder}/out")
print(verify(f"{folder}/out"), len(query.members(f"{folder}/out")))
"""
    done = house("-c", show, str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [scene.hash, *columns, "[]", str(scene.n_members)]
