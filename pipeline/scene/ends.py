"""The dataset at whose ends members start, as a scene names it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from stickslip.pipeline.errors import SceneError, StoreError, foreign
from stickslip.pipeline.places.manifest import read_manifest


@dataclass(frozen=True, slots=True)
class Ends:
    """A dataset at whose ends members start: its name beside the scene, a digest of its data, and where it lies."""

    name: str
    sha256: str
    at: str = field(compare=False)

    @property
    def word(self) -> str:
        """What stands for it in a member's name."""
        return f"e{self.sha256[:12]}"


def place_beside(name: str, folder: Path) -> str:
    """The place of a dataset that a scene names: an address, or a path beside the scene or above it."""
    if "://" in name:
        return name
    places = (folder, *folder.resolve().parents)
    return str(next((place / name for place in places if (place / name).is_dir()), folder / name).resolve())


def look_at_dataset(name: str, folder: Path) -> str:
    """The digest of the data of a dataset.

    Raises `SceneError` if there is no such dataset.
    """
    try:
        return read_manifest(place_beside(name, folder)).digest
    except StoreError as error:
        raise SceneError(f"start.dataset: {error}") from None
    except (OSError, ValueError) as error:  # a name that no path can have
        raise SceneError(f"start.dataset: expected a path, got {foreign(error, 100)}; correct it") from None
