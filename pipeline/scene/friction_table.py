"""A table of friction beside a scene: a text of two columns, speeds of slip and coefficients."""

from __future__ import annotations

import re
from pathlib import Path

from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.own.files import content_of

KEY = "system.weakening.table"
#: Bytes of a file at most.
_MOST = 100_000


def read_friction_table(name: str, folder: Path) -> dict[str, list[float]]:
    """The columns of a file, `speeds` and `coefficients`; a first line without numbers is a heading.

    Columns are parted by commas, semicolons or blanks; lines that begin with # are left out. Raises `SceneError` if
    the file cannot be read, or a line is not two numbers.
    """
    content = content_of(folder / name, KEY)
    if len(content) > _MOST:
        raise SceneError(f"{KEY}: expected at most {_MOST} bytes in {name}, got {len(content)}; leave out values")
    text = content.decode("utf-8-sig", errors="replace")
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    rows: list[list[float]] = []
    for place, (k, line) in enumerate(lines):
        try:
            speed, coefficient = map(float, re.split(r"[\s,;]+", line.strip().strip(",;")))
        except ValueError:
            if place == 0 and not re.search(r"\d", line):
                continue
            raise SceneError(
                f"{KEY}: {name}: expected two numbers a line, a speed and a coefficient, got {line.strip()[:40]!r} in"
                f" line {k}; correct it"
            ) from None
        rows.append([speed, coefficient])
    return {"speeds": [row[0] for row in rows], "coefficients": [row[1] for row in rows]}
