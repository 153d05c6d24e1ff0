"""Names of groups of members: the number of blocks, the engine, and whatever tells each from the others."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from stickslip.pipeline.design.values import Value, text
from stickslip.sim.engines import ENGINES, SETTINGS

Part = tuple[str, str]


class Label(str):
    """A name of a group, and the parts that it is made of: name and value; an engine has no name."""

    parts: tuple[Part, ...] = ()

    @classmethod
    def of(cls, parts: Sequence[Part]) -> Label:
        """From its parts."""
        found = cls(", ".join(f"{name} = {value}" if name else value for name, value in parts))
        found.parts = tuple(parts)
        return found


def engine_name(engine: str) -> str:
    """The name of an engine on pages."""
    return ENGINES[engine].title


def apart(labels: Sequence[Label], always: int = 0) -> list[Label]:
    """What tells each of some groups from the others, after so many of the first parts of its name."""
    shared = set.intersection(*(set(label.parts) for label in labels)) if labels else set()
    return [
        Label.of([*label.parts[:always], *(part for part in label.parts[always:] if part not in shared)])
        for label in labels
    ]


def labels(keys: Sequence[Mapping[str, Any]], swept: Sequence[Mapping[str, Value]] = ()) -> list[Label]:
    """Names of groups: n, engine, its rule of sticking, and whatever distinguishes each from the others.

    Parameters
    ----------
    keys : sequence of mapping
        The settings of each, by column.
    swept : sequence of mapping, optional
        What each has of the keys that are swept.
    """
    values: dict[tuple[str, str], set[Any]] = {}
    swept = swept or [{}] * len(keys)
    for key, at in zip(keys, swept, strict=True):
        for name, value in (*key.items(), *_without_column(key, at).items()):
            values.setdefault((key["engine"], name), set()).add(value)
    differ = {place for place, some in values.items() if len(some) > 1}
    if all("w0" in key and key["w0"] == key["belt_speed"] for key in keys):
        differ -= {(key["engine"], "w0") for key in keys}  # all start on the belt
    return [_label(key, differ, at) for key, at in zip(keys, swept, strict=True)]


def _without_column(key: Mapping[str, Any], swept: Mapping[str, Value]) -> dict[str, Value]:
    """What is swept and no number in a column of its own: what is drawn, and parameters of a function."""
    columns = {name.removesuffix("0"): value for name, value in key.items()}
    return {name: value for name, value in swept.items() if columns.get(name) is None}


def _label(key: Mapping[str, Any], differ: Collection[tuple[str, str]], swept: Mapping[str, Value]) -> Label:
    """Name of a group; `differ` holds engine and name of each setting in which groups of that engine differ."""
    parts = [("n", str(key["n"])), ("", engine_name(key["engine"]))]
    defaults = ENGINES[key["engine"]].defaults()
    of_columns = {name.removesuffix("0") for name in key}
    others = {name: value for name, value in _without_column(key, swept).items() if (key["engine"], name) in differ}
    for name, value in key.items():
        if name in ("parameters", "drawn"):
            parts += [(one, text(said)) for one, said in others.items() if (one in of_columns) == (name == "drawn")]
        elif value is not None and name not in ("n", "engine", "perturbation_size"):
            rule = SETTINGS[name].in_label if name in SETTINGS else "if it differs"
            is_said = rule == "always" or (rule == "unless default" and value != defaults[name])
            if is_said or (key["engine"], name) in differ:
                parts.append((name, text(value)))
    if key["perturbation_size"] > 0:
        parts.append(("", f"perturbed by {text(key['perturbation_size'])}"))
    return Label.of(parts)
