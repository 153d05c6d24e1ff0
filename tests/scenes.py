"""Small scenes, as the text of their files."""

from __future__ import annotations

import re
from pathlib import Path

#: Blocks of a chain at random places on their belts.
ON_BELTS = 'z = {uniform = [-0.2, 0.2]}\nw = "belt"'
COULOMB, SIGMOID = 'name = "coulomb"', 'name = "sigmoid"'
#: How the text of a scene of short runs ends.
ENDING = """\
[[engine]]
name = "coulomb"
tol = 1e-6
[analysis]
t_burn = 1.0
dt = 0.5
"""


def ensemble(
    n: object,
    t_end: float,
    matrices: int,
    *engines: str,
    seed: object = 0,
    title: str = "small",
    system: str = 'coupling = "antisymmetric"',
    start: str = "z = -0.7\nw = -0.4",
    rest: str = "",
    analysis: str = "t_burn = 1.0\ndt = 0.5",
) -> str:
    """Random systems from the paper's start, or others; `engines` are the keys of each table, `rest` more tables."""
    tables = {
        "[system]": f"{system}\nn = {n}",
        "[start]": start,
        "[run]": f"t_end = {t_end}\nmatrices = {matrices}\nseed = {seed}",
    }
    parts = [f'title = "{title}"', *(f"{head}\n{keys}" for head, keys in tables.items())]
    parts += [f"[[engine]]\n{keys}" for keys in engines or (COULOMB, SIGMOID)]
    parts += [rest.strip()] * bool(rest)
    return "\n\n".join([*parts, f"[analysis]\n{analysis}\n"])


def own_law() -> str:
    """The guide's law of friction, `Lorentz`, as the text of its module."""
    page = (Path(__file__).parents[1] / "docs" / "guide" / "systems.md").read_text()
    return next(
        block for block in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL) if "class Lorentz" in block
    )
