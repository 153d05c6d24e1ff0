"""The scenes that ship with the package: TOML files beside this one."""

from __future__ import annotations

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
