"""The scenes that ship with the package: TOML files beside this one."""

from __future__ import annotations

import tomllib
from pathlib import Path

_HERE = Path(__file__).parent


def shipped() -> dict[str, Path]:
    """Name -> file of every scene that ships, by name."""
    return {file.stem: file for file in sorted(_HERE.glob("*.toml"))}


def find(scene: str) -> Path:
    """The file of a scene given as a path or as the name of a shipped one; a path that exists wins."""
    path = Path(scene)
    if path.suffix == ".toml" or path.exists():
        return path
    return shipped().get(scene, path)


def chart_of(file: Path) -> str | None:
    """The chart that a scene file asks for in its key `chart`; None for an ensemble, or no scene at all."""
    try:
        chart = tomllib.loads(file.read_text(encoding="utf-8")).get("chart")
    except (OSError, ValueError, RecursionError):  # whoever loads it as a scene says what is wrong with it
        return None
    return None if chart is None else str(chart)
