"""A table of friction beside a scene: two columns, speeds of slip and coefficients."""

from __future__ import annotations

from pathlib import Path

from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.own.files import content_of
from stickslip.pipeline.scene.systems import read_series

KEY = "system.weakening.table"
#: Bytes of a file at most.
_MOST = 100_000


def read_friction_table(name: str, folder: Path) -> dict[str, list[float]]:
    """The columns of a file, `speeds` and `coefficients`.

    Raises `SceneError` if the file cannot be read, or does not hold two columns of numbers.
    """
    content = content_of(folder / name, KEY)
    if len(content) > _MOST:
        raise SceneError(f"{KEY}: expected at most {_MOST} bytes in {name}, got {len(content)}; leave out values")
    speeds, coefficients = read_series(KEY, name, content)
    return {"speeds": speeds.tolist(), "coefficients": coefficients.tolist()}
