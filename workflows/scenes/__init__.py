"""The scenes that ship with the package: TOML files beside this one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stickslip.pipeline import Scene

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


def load(file: Path) -> Scene:
    """Read a scene file as `stickslip.pipeline.load_scene` does, and look at the questions that it names.

    Raises
    ------
    SceneError
        As there, or if a report cannot answer such a question.
    """
    from stickslip.pipeline import load_scene

    return with_known_questions(load_scene(file), str(file))


def with_known_questions(scene: Scene, name: str) -> Scene:
    """The scene itself; SceneError if it names a question that a report cannot answer. `name` is for the message."""
    from stickslip.analysis.questions import refuse_unknown
    from stickslip.pipeline.errors import SceneError

    try:
        refuse_unknown(scene.analysis.question)
    except ValueError as error:
        raise SceneError(f"{name}: analysis.{error}") from None
    return scene


def chart_of(file: Path) -> str | None:
    """The chart that a scene file asks for in its key `chart`; None for an ensemble, or no scene at all."""
    from stickslip.pipeline.errors import SceneError
    from stickslip.pipeline.scene.source import parse_toml, read_source

    try:
        chart = parse_toml(read_source(file), str(file)).get("chart")
    except SceneError:  # whoever loads it as a scene says what is wrong with it
        return None
    return None if chart is None else str(chart)
