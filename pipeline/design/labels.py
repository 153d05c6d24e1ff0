"""Names of groups of members: the number of blocks, the engine, and whatever tells each from the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from stickslip.pipeline.design.values import Values, text
from stickslip.sim.engines import ENGINES, SETTINGS, place

Part = tuple[str, str]


class Label(str):
    """A name of a group, and the parts that it is made of: name and value; an engine has no name."""

    parts: tuple[Part, ...] = ()

    @classmethod
    def of(cls, pairs: Sequence[Part]) -> Label:
        """From its parts."""
        label = cls(", ".join(f"{name} = {value}" if name else value for name, value in pairs))
        label.parts = tuple(pairs)
        return label


def engine_name(engine: str) -> str:
    """The name of an engine on pages."""
    return ENGINES[engine].title


def engine_noun(engine: str, words: str = "") -> str:
    """An engine as a noun, "the exact law"; or the words that call it, if they are more than its name."""
    return words if words not in ("", engine_name(engine)) else ENGINES[engine].noun or ENGINES[engine].title


def engines_in_words(engines: Collection[str]) -> str:
    """What some engines are, a sentence each, under their names on pages."""
    named = (ENGINES[engine] for engine in sorted(engines, key=place))
    return " ".join(f"{engine.title.capitalize()}: {engine.about}" for engine in named)


def apart(labels: Sequence[Label], always: int = 0) -> list[Label]:
    """What tells each of some groups from the others, after so many of the first parts of its name."""
    shared = set.intersection(*(set(label.parts) for label in labels)) if labels else set()
    return [
        Label.of([*label.parts[:always], *(pair for pair in label.parts[always:] if pair not in shared)])
        for label in labels
    ]


def labels(keys: Sequence[Mapping[str, Any]]) -> list[Label]:
    """Names of groups: n, engine, its rule of sticking, and whatever distinguishes each from the others.

    Parameters
    ----------
    keys : sequence of mapping
        The settings of each, by column; `Values` have names of their own.
    """
    values: dict[tuple[str, str], list[Any]] = {}
    for key in keys:
        for name, value in _settings(key):
            values.setdefault((key["engine"], name), []).append(value)
    n_groups = Counter(key["engine"] for key in keys)
    differ = {place for place, texts in values.items() if len(set(texts)) > 1 or len(texts) < n_groups[place[0]]}
    if all("w0" in key and key["w0"] == key["belt_speed"] for key in keys):
        differ -= {(key["engine"], "w0") for key in keys}  # all start on the belt
    return [_label(key, differ) for key in keys]


def _settings(key: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """What a group has, by name."""
    for name, value in key.items():
        if value is not None:
            yield from value if isinstance(value, Values) else ((name, value),)


def _label(key: Mapping[str, Any], differ: Collection[tuple[str, str]]) -> Label:
    """Name of a group; `differ` holds engine and name of each setting in which groups of that engine differ."""
    pairs = [("n", str(key["n"])), ("", engine_name(key["engine"]))]
    defaults = ENGINES[key["engine"]].defaults()
    for name, value in _settings(key):
        if name in ("n", "engine", "perturbation_size"):
            continue
        rule = SETTINGS[name].in_label if name in SETTINGS else "if it differs"
        is_said = rule == "always" or (rule == "unless default" and value != defaults[name])
        if is_said or (key["engine"], name) in differ:
            pairs.append((name, text(value)))
    if key["perturbation_size"] > 0:
        pairs.append(("", f"perturbed by {text(key['perturbation_size'])}"))
    return Label.of(pairs)
