"""[system]: the systems of a scene: drawn from an ensemble, tied along a graph, from files or by a function."""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    WithJsonSchema,
    create_model,
    model_validator,
)

from stickslip.pipeline.design.values import (
    Course,
    InTime,
    Measured,
    OnBlocks,
    Push,
    Pushes,
    Quantity,
    as_written,
    size,
    values,
)
from stickslip.pipeline.own.function import PATTERN
from stickslip.pipeline.scene.quantity import AnyNumber, Key, course
from stickslip.pipeline.scene.source import REALISATION
from stickslip.pipeline.scene.toml import (
    SEVERAL,
    SINGLE,
    BlockNumbers,
    Blocks,
    List,
    Natural,
    StrictTable,
    as_tuple,
    distinct,
    once,
    optional,
    shown,
)
from stickslip.sim.numerics.arguments import did_you_mean
from stickslip.sim.runs.blocks import named, numbered
from stickslip.sim.systems.couplings import COUPLINGS
from stickslip.sim.systems.drive import direction
from stickslip.sim.systems.graphs import GRAPHS
from stickslip.sim.systems.system import NORMAL_FORCE
from stickslip.sim.systems.terms import OF_BLOCKS, TERMS, Term
from stickslip.sim.systems.weakening import LAWS, Table

#: The names of the couplings whose systems are read from files: K itself, or the graph that springs lie along.
OF_FILE, OF_GRAPH = OF_FILES = ("file", "graph")


#: The keys that a force is given by: a harmonic one, or one that is linear between times.
_FORCES = (("amplitude", "frequency"), ("times", "values"), ("table",))

_HARMONIC = (*_FORCES[0], "phase")


def is_function(coupling: str) -> bool:
    """Whether a coupling names a function that makes the systems."""
    return re.match(PATTERN, coupling) is not None


def _coupling(name: str) -> str:
    names = (*COUPLINGS, *GRAPHS, *OF_FILES)
    if name not in names and not is_function(name):
        if ":" in name:
            raise ValueError(f"expected module:function, as in own:draw, got {name!r}; name a file own.py so")
        raise ValueError(f"expected one of {', '.join(names)}, got {name!r}{did_you_mean(name, names)}")
    return name


class ModuleTable(StrictTable):
    """The module whose function makes the systems, as it was when the scene was read; see `systems`."""

    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    is_sparse: bool
    entries_by_block: Natural
    beside: dict[str, str] = Field(default_factory=dict)
    names: Annotated[tuple[str, ...], List] = ()
    means: dict[str, float] = Field(default_factory=dict)


class FileTable(StrictTable):
    """A file that a system is read from, as it was when the scene was read; see `systems`."""

    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    n: Blocks
    scale: Natural
    entries: Annotated[int, Field(ge=0)]
    is_sparse: bool
    arrays: Annotated[tuple[str, ...], List]
    version: Literal[1, 2, 3] = 1  # of how draws are numbered; older datasets do not say
    parameters: dict[str, float] = Field(default_factory=dict)
    names: Annotated[tuple[str, ...], List] = ()
    variable: str = ""
    others: dict[str, Annotated[tuple[str, str], List]] = Field(default_factory=dict)  # by array: file and variable


def _with_terms(table: str, behind: type[StrictTable] = StrictTable, required: Collection[str] = ()) -> Any:
    """A table with a key for each term of a table in [system], behind the keys that it has."""
    keys: dict[str, Any] = {
        term.key: (_kind(term), Field(**term.field | ({"default": ...} if term.key in required else {})))
        for term in TERMS
        if term.table == table
    }
    return create_model(f"_{table}", __base__=behind, **keys)


def _kind(term: Term) -> Any:
    """What may be written for a term."""
    kind = Annotated[Quantity, Key(term.draws, term.least, (), term.is_above, term.in_time, term.ratio_of)]
    return kind if term.is_argument and term.default is not None else kind | None


class ForceTable(_with_terms("force")):  # type: ignore[misc]
    """[system.force]: a force from outside on every block: amplitude cos(frequency t + phase), or by times."""

    model_config = ConfigDict(json_schema_extra={"oneOf": [{"required": [*form]} for form in _FORCES]})
    times: Annotated[tuple[float, ...], List] | None = optional(
        "times between which the force is linear; it is constant before and after", [0.0, 100.0]
    )
    values: Annotated[tuple[float, ...], List] | None = optional(
        "the force on every block at these times", [0.0, 0.5]
    )
    table: str | None = optional("file beside the scene with two columns, times and values", "force.csv")
    columns: Annotated[tuple[str | int, ...], List] | None = optional(
        "which columns, by their headings or by number from 0, or which arrays of the file", ["t", "force"]
    )
    series: Annotated[dict[str, Any] | None, WithJsonSchema({"type": "object"})] = optional(
        "what the table was when the scene was read: written by stickslip"
    )
    blocks: (
        Annotated[
            tuple[Annotated[int, Field(ge=0)] | str, ...],
            Field(min_length=1),
            BeforeValidator(as_tuple),
            AfterValidator(once),
        ]
        | None
    ) = optional("the blocks it acts on, by name, or by number from 0; all if left out", [0])

    @model_validator(mode="before")
    @classmethod
    def _one_form(cls, table: Any) -> Any:
        keys = set(table) if isinstance(table, dict) else set()
        if keys - set(cls.model_fields):
            return table  # unknown keys are refused by name
        keys -= {"blocks", "columns", "series"}
        if keys - {"phase"} not in map(set, _FORCES) or ("phase" in keys and not keys >= {*_FORCES[0]}):
            raise ValueError(
                f"expected amplitude and frequency, or times and values, or a table, and `blocks` or none, got"
                f" {shown(table)}; write e.g. {{amplitude = 0.5, frequency = 1.0, phase = 0.0}} or {{times = [0.0,"
                ' 100.0], values = [0.0, 0.5]} or {table = "force.csv"}'
            )
        if keys <= {*_FORCES[0], "phase"}:
            return table
        timed = course({key: table[key] for key in ("times", "values", "table", "columns", "series") if key in table})
        return {**table, **as_written(timed), "phase": None}

    @property
    def course(self) -> Course | Measured | None:
        """The force by its values at given times."""
        if self.table is not None:
            written = {"table": self.table, "columns": self.columns or (), "series": self.series}
            return course({key: value for key, value in written.items() if value is not None})
        return None if self.times is None or self.values is None else Course(self.times, self.values)

    @property
    def on_blocks(self) -> OnBlocks | None:
        """The blocks it acts on; None: all."""
        if self.blocks is None:
            return None
        return OnBlocks(tuple(int(block) for block in self.blocks))  # by number: see `SystemTable._names_apply`


def _none_swept(forces: tuple[ForceTable, ...]) -> tuple[ForceTable, ...]:
    if not forces:
        raise ValueError("expected one force or more, got []; write e.g. {amplitude = 0.5, frequency = 1.0}")
    for k, force in enumerate(forces):
        for key in _HARMONIC:
            if isinstance(getattr(force, key), tuple):
                raise ValueError(
                    f"expected one value of each key where there are several forces, got a list for {key} of force"
                    f" {k}; a sweep takes one force"
                )
    return forces


if TYPE_CHECKING:
    Forces = ForceTable | tuple[ForceTable, ...]
else:
    Forces = Annotated[
        Annotated[ForceTable, Tag(SINGLE)]
        | Annotated[tuple[ForceTable, ...], List, AfterValidator(_none_swept), Tag(SEVERAL)],
        Discriminator(lambda force: SEVERAL if isinstance(force, list | tuple) else SINGLE),
    ]


class _Law(StrictTable):
    law: Literal[*LAWS] | None = optional(", or ".join(law.formula for law in LAWS.values()), "rational")  # type: ignore[valid-type]
    table: str | None = optional(
        "in the place of `law`: file beside the scene with two columns, speeds of slip and coefficients"
        " by which friction is multiplied",
        "friction.csv",
    )
    speeds: Annotated[tuple[float, ...], List] | None = optional(
        "the speeds of the table themselves, from 0", [0.0, 0.1, 0.5, 2.0]
    )
    coefficients: Annotated[tuple[float, ...], List] | None = optional(
        "the coefficients at these speeds", [0.6, 0.4, 0.35, 0.4]
    )


class WeakeningTable(_with_terms("weakening", _Law)):  # type: ignore[misc]
    """[system.weakening]: how kinetic friction falls with slip speed; see `stickslip.sim.systems.weakening`."""

    @property
    def curve(self) -> Table | None:
        """The law of a table."""
        if self.law is not None or self.speeds is None or self.coefficients is None:
            return None
        return Table(self.speeds, self.coefficients)

    @model_validator(mode="after")
    def _either_law_or_table(self) -> Self:
        by_table = [key for key in ("table", "speeds", "coefficients") if getattr(self, key) is not None]
        if self.law is None and self.curve is None:
            what = f"no speeds and coefficients beside `{by_table[0]}`" if by_table else "neither"
            raise ValueError(
                f'law: expected a law or a table, got {what}; write e.g. `law = "rational"`, or a scene file with'
                ' `table = "friction.csv"`'
            )
        if self.law is not None and by_table:
            raise ValueError(f"law: expected either a law or a table, got `law` and `{by_table[0]}`; remove one")
        parameters = {} if self.law is None else LAWS[self.law].parameters()
        for key, name in ((key, law.name) for law in LAWS.values() for key in law.parameters()):
            if key not in parameters and (got := getattr(self, key)) is not None:
                needed = " and ".join(f"`{needed}`" for needed in parameters)
                beside = f'with law = "{self.law}", which takes {needed}' if self.law else "beside a table"
                raise ValueError(f'{key}: expected none {beside}, got {got}; remove it, or write law = "{name}"')
        for key, parameter in parameters.items():
            if getattr(self, key) is None:
                example = f"`{key} = {parameter['example']}`"
                raise ValueError(f'{key}: expected that of law = "{self.law}", found nothing; write e.g. {example}')
        return self


def _pair(given: Any) -> Any:
    """`[a, b]` as its table; what is swept is written by keys."""
    if not isinstance(given, list | tuple):
        return given
    if len(given) != 2 or not all(isinstance(number, int | float) for number in given):
        raise ValueError(
            f"expected two numbers, a and b of C = a M + b K, got {shown(given)}; write e.g. [0.05, 0.1], or to sweep"
            " one of them {mass = 0.05, stiffness = [0.1, 0.2]}"
        )
    return dict(zip(("mass", "stiffness"), given, strict=True))


class RayleighTable(_with_terms("rayleigh")):  # type: ignore[misc]
    """[system.rayleigh]: damping in proportion to masses and stiffnesses, C = mass M + stiffness K."""


class _Driven(StrictTable):
    block: Annotated[int, Field(ge=0)] | str = Field(
        description="the block that the drive is tied to, by name, or by number from 0", examples=["table"]
    )


class DriveTable(_with_terms("drive", _Driven, ("spring", "speed"))):  # type: ignore[misc]
    """[system.drive]: a drive that draws a block along through a spring; see `stickslip.sim.systems.driven`."""


#: The keys that may hold lists and distributions, by their names in a grid, in ids and columns: the table in [system]
#: that they stand in, "" for itself, and the key there.
QUANTITIES = {term.name: (term.table, term.key) for term in TERMS}
QUANTITIES["force_course"] = ("force", "course")  # a force that is given by times and values


def _either_files(schema: dict[str, Any]) -> None:
    """Let editors accept a system without n, if it is read from files."""
    required = schema.pop("required")
    of_files = {"properties": {"coupling": {"enum": [*OF_FILES]}}}
    schema |= {"if": of_files, "then": {"required": required}, "else": {"required": [*required, "n"]}}


#: What files may give of a system.
_ARRAYS = ("stiffness", *OF_BLOCKS, "z0", "w0")


def _path(given: Any) -> Any:
    """A file, or a table with a file for each array, by its name."""
    files = given if isinstance(given, dict) else {"stiffness": given}
    if given is None or all(name in _ARRAYS and isinstance(file, str) for name, file in files.items()):
        return given
    raise ValueError(
        f"expected the name of a file, or files of {', '.join(_ARRAYS)}, got {shown(given)}; write e.g. path ="
        ' "K.npz", or {stiffness = "K.csv", damping = "C.csv"}'
    )


def _contacts(given: Any) -> Any:
    """Blocks as a tuple; what is said of contacts besides is refused."""
    blocks = as_tuple(given)
    if isinstance(given, dict) or (isinstance(blocks, tuple) and any(isinstance(block, dict) for block in blocks)):
        raise ValueError(
            f'expected the blocks that have friction, as in [system] contacts = ["bit"], got {shown(given)};'
            f" {NORMAL_FORCE}"
        )
    return blocks


#: What users may call the normal force of a contact, and its loss.
_NORMAL_FORCES = ("normal", "normal_force", "normal_load", "lift_off")


class _Source(StrictTable):
    model_config = ConfigDict(json_schema_extra=_either_files)
    coupling: Annotated[str, AfterValidator(_coupling)] = Field(
        description="name of the ensemble, or of the graph that springs lie along; that K, or a graph, is read from a"
        " file; or the function that makes the systems, as module:function",
        examples=["antisymmetric"],
        json_schema_extra={"anyOf": [{"enum": [*COUPLINGS, *GRAPHS, *OF_FILES]}, {"pattern": PATTERN}]},
    )
    n: BlockNumbers = Field(
        default_factory=tuple,
        description="number of blocks, or a list of numbers; with files of K that of these, and may be left out",
        examples=[200],
    )
    path: Annotated[str | dict[Literal[*_ARRAYS], str], BeforeValidator(_path)] | None = optional(  # type: ignore[valid-type]
        "file of K, .npz, .npy, Matrix Market, .mat or CSV, or of a graph, beside the scene; or several,"
        " by a pattern; or a table with the file of each array",
        "K.npz",
    )


class SystemTable(_with_terms("", _Source)):  # type: ignore[misc]
    """[system]: what the systems are drawn from."""

    force: Forces | None = optional("an external force, or a list of forces that act together; see [system.force]")
    rayleigh: Annotated[RayleighTable | None, BeforeValidator(_pair)] = optional(
        "[a, b] of the damping matrix C = a M + b K, in the place of `rho`"
    )
    weakening: WeakeningTable | None = None
    drive: DriveTable | None = optional("a drive that draws a block along through a spring; see [system.drive]")
    contacts: Annotated[tuple[Annotated[int, Field(ge=0)] | str, ...], BeforeValidator(_contacts)] | None = optional(
        "the blocks that have friction, by name, or by number from 0; all if left out", ["bit"]
    )
    back_slip: bool = Field(
        default=True,
        description="whether blocks may slip either way; if not, none gets ahead of its belt",
        examples=[False],
    )
    names: Annotated[tuple[str, ...], List] | None = optional(
        "a name for each block, by which keys, records and figures call it; or those of the file or the function",
        ["table", "pipe", "bit"],
    )
    parameters: dict[str, AnyNumber] | None = optional(
        "what the function is given beside n and rng, by name", {"gap": 0.5}
    )
    module: Annotated[ModuleTable | None, WithJsonSchema({"type": "object"})] = optional(
        "what the module was when the scene was read: written by stickslip"
    )
    files: Annotated[dict[str, FileTable] | None, WithJsonSchema({"type": "object"})] = optional(
        "what the files were when the scene was read: written by stickslip"
    )

    @model_validator(mode="before")
    @classmethod
    def _no_normal_force(cls, table: Any) -> Any:
        for key in _NORMAL_FORCES if isinstance(table, dict) else ():
            if key in table:
                raise ValueError(
                    f"{key}: expected none, got {shown(table[key])}: `friction` is the coefficient times the normal"
                    f" force; {NORMAL_FORCE}"
                )
        return table

    @property
    def quantities(self) -> dict[str, Quantity | None]:
        """What may be a list or a distribution: by the names in `QUANTITIES`, and parameters by their own."""
        parameters = self.parameters or {}
        places = {name: place for name, place in QUANTITIES.items() if name not in parameters}
        return {
            name: getattr(getattr(self, t) if t else self, key, None) for name, (t, key) in places.items()
        } | parameters

    @property
    def forces(self) -> tuple[ForceTable, ...]:
        """All forces."""
        return () if self.force is None else self.force if isinstance(self.force, tuple) else (self.force,)

    @property
    def pushes(self) -> Pushes | None:
        """The forces, where they are several; of one, the numbers are quantities."""
        if not isinstance(self.force, tuple):
            return None
        return Pushes(
            tuple(
                Push(tuple(getattr(force, key) for key in _HARMONIC), force.course, force.on_blocks)
                for force in self.force
            )
        )

    def place_of(self, name: str, tables: dict[str, Any]) -> tuple[dict[str, Any], str]:
        """The table that holds one of the quantities, within a dump of this one, and its key there."""
        table, key = ("parameters", name) if name in (self.parameters or ()) else QUANTITIES[name]
        return tables[table] if table else tables, key

    @property
    def readings(self) -> tuple[str, ...]:
        """The readings of a perturbation that keep what the system is."""
        is_drawn = self.coupling in COUPLINGS and self.rayleigh is None and self.drive is None
        names = COUPLINGS[self.coupling].readings if is_drawn else ()
        return names if self.damping is None else tuple(set(names) & {"relative"})  # there is no scale of R

    @property
    def bytes_of_system(self) -> float:
        """About how many bytes drawing the largest system takes."""
        n = max(self.n)
        if self.coupling in COUPLINGS:
            coupling = COUPLINGS[self.coupling]
            n_entries = n**2 if coupling.is_dense else 0
            return 3.0 * 8 * max(math.prod(coupling.shape(n)), n_entries)  # a draw, its transpose and their sum
        if self.is_of_files:
            return max((100.0 if file.is_sparse else 24.0) * file.entries for file in self.known_files.values())
        if self.module is not None:
            return 100.0 * n * self.module.entries_by_block if self.module.is_sparse else 24.0 * n**2
        return 100.0 * n * (1.0 + size(self.degree or 4.0))

    @property
    def is_own(self) -> bool:
        """Whether a function of the user's makes the systems."""
        return is_function(self.coupling)

    @property
    def is_of_files(self) -> bool:
        """Whether K, or a graph, is read from files."""
        return self.coupling in OF_FILES

    @property
    def known_files(self) -> dict[str, FileTable]:
        """The files that systems are read from, by their names beside the scene."""
        return self.files or {}

    @property
    def assumes_masses(self) -> bool:
        """Whether K is read from files and masses, which nothing gives, are 1."""
        given = [*self.known_files.values()]
        return self.coupling == OF_FILE and self.mass is None and not all("mass" in file.arrays for file in given)

    @property
    def rubbing(self) -> OnBlocks | None:
        """The blocks that have friction; None: all."""
        return None if self.contacts is None else OnBlocks(tuple(int(block) for block in self.contacts))

    @property
    def block_names(self) -> tuple[str, ...]:
        """The names of the blocks, given here, in the files or by the function; empty if they have none."""
        if self.names is not None:
            return self.names
        return next(
            (facts.names for facts in (self.module, *self.known_files.values()) if facts is not None and facts.names),
            (),
        )

    def _names_apply(self) -> None:
        """Names fit the blocks, and forces that name blocks are on their numbers from here on."""
        of_files = {file.names for file in self.known_files.values()}
        if len(of_files) > 1 or (self.names is not None and any(of_files)):
            raise ValueError(
                "names: expected the same in each file, or here alone, got several; leave out the others"
            )
        for n in self.n if self.block_names else ():
            named(self.block_names, n)
        for k, force in enumerate(self.forces):
            key = f"force[{k}].blocks" if isinstance(self.force, tuple) else "force.blocks"
            if force.blocks is not None:
                object.__setattr__(force, "blocks", self._numbers(key, force.blocks))
        if self.contacts is not None:
            object.__setattr__(self, "contacts", self._numbers("contacts", self.contacts))
        if self.drive is not None:
            (block,) = self._numbers("drive.block", (self.drive.block,))
            object.__setattr__(self.drive, "block", block)

    def _numbers(self, key: str, blocks: tuple[int | str, ...]) -> tuple[int, ...]:
        """The numbers of blocks that a key names, each once, in order."""
        names = self.block_names
        place = {name: k for k, name in enumerate(names)}
        numbers = [place[block] if block in place else numbered(key, block, names, min(self.n)) for block in blocks]
        if len({*numbers}) < len(numbers) or not numbers:
            raise ValueError(f"{key}: expected each block once, and some, got {shown([*blocks])}; write each once")
        return tuple(sorted(numbers))

    def _files_apply(self) -> None:
        if isinstance(self.path, dict) and ("stiffness" not in self.path or self.coupling == OF_GRAPH):
            raise ValueError(
                f'path: expected a file for `stiffness`, with coupling = "{OF_FILE}", got those of'
                f' {", ".join(self.path)}; write e.g. {{stiffness = "K.csv", damping = "C.csv"}}'
            )
        if self.path is None:
            raise ValueError('path: expected the file of K or of the graph, found nothing; add `path = "K.npz"`')
        if not self.files:
            raise ValueError("files: expected what `load_scene` and the command write here, found nothing; use these")
        reference, names_by_digest = next(iter(self.files.values())), dict[str, str]()
        sizes = sorted({file.n for file in self.files.values()})
        if not self.n:
            object.__setattr__(self, "n", distinct(tuple(sizes)))
        if {*self.n} != {*sizes}:
            raise ValueError(
                f"n: expected the numbers of blocks of the files, {sizes}, got {list(self.n)}; leave n out"
            )
        realisations = dict[object, str]()
        for name, file in self.files.items():
            written_keys = {key for key in self.model_fields_set if getattr(self, key) is not None}
            for array in OF_BLOCKS:
                keys = {array, "rho", "rayleigh"} if array == "damping" else {array}
                if array in file.arrays and keys & written_keys:
                    key = sorted(keys & written_keys)[0]
                    raise ValueError(f"{key}: expected none beside the array `{array}` of {name}, got one; remove it")
            twin = names_by_digest.setdefault(file.sha256, name)
            if twin != name and not file.parameters:  # else realisations that came out the same
                raise ValueError(
                    f"path: expected files that differ, got {twin} and {name}, which are equal; remove one"
                )
            if file.parameters.keys() != reference.parameters.keys():
                odd = sorted(file.parameters.keys() ^ reference.parameters.keys())[0]
                raise ValueError(
                    f"path: expected the same numbers in each file, got one without `{odd}`; add it there"
                )
            twin = realisations.setdefault((file.n, *sorted(file.parameters.items())), name)
            if twin != name and REALISATION in file.parameters:  # they would count as one system
                raise ValueError(
                    "path: expected a `realisation` of its own in each file with the same numbers otherwise, got"
                    f" {file.parameters[REALISATION]:g} in {twin} and {name}; number them"
                )

    def _function_applies(self) -> None:
        if self.module is None:
            raise ValueError(
                "module: expected what `load_scene` and the command write here, found nothing; use these"
            )
        for key in {"friction", "belt_speed"} - self.model_fields_set:
            object.__setattr__(self, key, None)

    @model_validator(mode="after")
    def _only_what_applies(self) -> Self:
        """What is not used is refused, and no part of the data."""
        of_file, why = self.is_of_files, ""
        if not self.n and not of_file:
            raise ValueError("n: expected the number of blocks, or a list of numbers, found nothing; add `n = 200`")
        if self.coupling == OF_FILE or self.is_own:
            why = ", which has K itself" if of_file else ", which makes all of it from [system.parameters]"
        takes = GRAPHS[self.coupling].takes if self.coupling in GRAPHS else ()
        for key, is_used in (
            ("path", of_file), ("files", of_file), ("parameters", self.is_own), ("module", self.is_own),
            ("leaf", self.coupling in (*GRAPHS, OF_GRAPH)), ("degree", "degree" in takes),
            ("rewiring", "rewiring" in takes), ("kappa", not why), ("rho", not self.is_own),
        ):  # fmt: skip
            if not is_used:
                if key in self.model_fields_set and getattr(self, key) is not None:
                    raise ValueError(f'{key}: expected none with coupling = "{self.coupling}"{why}; remove it')
                object.__setattr__(self, key, None)
        if self.drive is not None and "belt_speed" not in self.model_fields_set:
            object.__setattr__(self, "belt_speed", 0.0)
        if of_file:
            self._files_apply()
        if self.is_own:
            self._function_applies()
        law = None if self.weakening is None else self.weakening.law
        if law and not of_file and not self.is_own:  # else that may hold static friction
            LAWS[law].require_static(self.static)
        if not self.back_slip and self.drive is None:  # else that of the drive counts too
            for speed in values(self.belt_speed):
                numbers = (speed,) if isinstance(speed, float) else ()
                speeds = speed.extremes if isinstance(speed, InTime) else numbers
                if speeds and not direction(np.array(speeds)):
                    raise ValueError(
                        f"belt_speed: expected with back_slip = false a belt that neither rests nor turns, got"
                        f" {speed}, which loads to neither side, or to both; change it, or remove `back_slip`"
                    )
        damped = [key for key in ("damping", "rayleigh") if getattr(self, key) is not None]
        if damped and "rho" in self.model_fields_set and self.rho is not None:
            damped.append("rho")
        if len(damped) > 1:
            raise ValueError(f"{damped[0]}: expected either `{damped[0]}` or `{damped[1]}`, got both; remove one")
        if damped:
            object.__setattr__(self, "rho", None)
        self._names_apply()
        for n, degree in product(self.n, values(self.degree)) if self.degree is not None else ():
            if expected := GRAPHS[self.coupling].expected(n, size(degree)):
                raise ValueError(f"degree: expected {expected}, got {size(degree):g}; change it")
        if self.rewiring is not None and size(self.rewiring) > 1:
            raise ValueError(f"rewiring: expected a probability, at most 1, got {size(self.rewiring):g}; lower it")
        return self
