"""The numbers that define a system, in one table for all floors.

A term is a row here, and its physics is in `System` and the engines. The row defines its key in a scene and the
values that it takes, the draws for each block and their seeds, the column of a dataset, and the words in ids, labels
and pages. Everything is dimensionless.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from typing import Any, Literal

from stickslip.sim.systems.weakening import LAWS

#: Distributions that a number of each block may be drawn from.
Draw = Literal["uniform", "normal"]


@dataclass(frozen=True, kw_only=True)
class Term:
    """A number of a system: one for all blocks, or one for each."""

    #: In ids, grids and columns, as "static" or "force_amplitude"; its key in [system], after `table` and "_".
    name: str
    words: str  #: of that key
    column: str = ""  #: description of its column, if not `words`; a number, null where blocks differ
    default: float | None = None
    example: float | None = None
    least: float | None = None  #: its least value, excluded if `is_above`
    is_above: bool = False
    ratio_of: str = ""  #: of which other term it may be a multiple, by a factor of at least 1; empty: of none
    in_time: bool = False  #: whether it may change in time, linear between given times
    #: Of what may be drawn, block by block, the first word of the key of its seed; None: it is one number a system.
    #: Never renumber: stored data depend on it.
    purpose: int | None = None
    #: Whether it is an argument of `System`, by its name, which a file of K may contain too, as an array with a
    #: number for each block. Else it is part of a coupling, a force or a friction law.
    is_argument: bool = False
    #: The optional part of a dataset with its column; see `stickslip.pipeline.scene.columns`. Empty: every dataset.
    part: str = ""
    table: str = ""  #: the inner table of [system] that contains its key
    #: The scale of `stickslip.Scales` that it is divided by where a scene has units; empty: none.
    dimension: str = ""
    heading: str = ""  #: heading of its column in a report's table of groups, if not the name

    @property
    def key(self) -> str:
        """Its key within its table."""
        return self.name.removeprefix(f"{self.table}_")

    @property
    def draws(self) -> tuple[Draw, ...]:
        """The distributions that it may be drawn from: with a least value none without bounds."""
        if self.purpose is None:
            return ()
        return ("uniform", "normal") if self.least is None else ("uniform",)

    @property
    def title(self) -> str:
        """Its heading in a report."""
        return self.heading or self.name.replace("_", " ")

    @property
    def described(self) -> str:
        """Description of its column."""
        return self.column or self.words

    @property
    def field(self) -> dict[str, Any]:
        """Its key in the schema of scenes."""
        examples = {} if self.example is None else {"examples": [self.example]}
        return {"default": self.default, "description": self.words, **examples}


_in_rayleigh, _in_force, _in_drive = (partial(Term, part=name, table=name) for name in ("rayleigh", "force", "drive"))

TERMS = (
    Term(
        name="kappa",
        words="scale of the stiffnesses; of a graph the springs between neighbours",
        column="scale of the stiffnesses",
        default=0.2,
        least=0,
        dimension="stiffness",
    ),
    Term(
        name="leaf",
        words="leaf spring of every block in a graph",
        column="stiffness of every block's leaf spring; null if drawn",
        default=0.1,
        least=0,
        purpose=8,
        part="graph",
        dimension="stiffness",
    ),
    Term(
        name="degree",
        words="mean number of neighbours in a graph that is drawn",
        column="mean number of neighbours; null if not a network",
        default=4.0,
        least=0,
        part="graph",
    ),
    Term(
        name="rewiring",
        words="probability that a spring of the graph `small_world` is rewired",
        default=0.1,
        least=0,
        part="rewiring",
    ),
    Term(name="rho", words="scale of the dampings", default=3.5, least=0, dimension="damping"),
    Term(
        name="damping",
        words="damping R of every block, of either sign, in the place of `rho`",
        column="damping R of every block; null if drawn",
        example=0.0,
        purpose=5,
        is_argument=True,
        part="damping",
        dimension="damping",
    ),
    _in_rayleigh(
        name="rayleigh_mass",
        words="a of the damping matrix C = a M + b K, in the place of `rho`",
        column="a of the damping matrix C = a M + b K",
        default=0.0,
        least=0,
        dimension="frequency",
    ),
    _in_rayleigh(
        name="rayleigh_stiffness",
        words="b of the damping matrix C = a M + b K",
        default=0.0,
        least=0,
        dimension="time",
    ),
    Term(
        name="friction",
        words="kinetic friction mu of every block",
        default=1.0,
        least=0,
        purpose=4,
        is_argument=True,
        dimension="force",
    ),
    Term(
        name="static",
        words="static friction of every block, at least the kinetic; the kinetic if left out",
        column="static friction of every block; null if drawn",
        example=1.3,
        least=0,
        ratio_of="friction",
        purpose=9,
        is_argument=True,
        part="static",
        dimension="force",
    ),
    Term(
        name="mass",
        words="mass of every block; 1 if left out",
        column="mass of every block; null if drawn",
        example=2.0,
        least=0,
        is_above=True,
        purpose=10,
        is_argument=True,
        part="mass",
        dimension="mass",
    ),
    Term(
        name="belt_speed",
        words="speed v of the belt, linear between times and constant beyond if it has any",
        column="speed v of the belt",
        default=-0.2,
        in_time=True,
        purpose=11,
        is_argument=True,
        dimension="speed",
    ),
    _in_force(
        name="force_amplitude",
        words="amplitude of the force on every block",
        column="amplitude of the force on every block; null if drawn",
        example=0.5,
        purpose=12,
        heading="force",
        dimension="force",
    ),
    _in_force(
        name="force_frequency",
        words="frequency of the force, in radians a unit of time; 0: constant",
        column="frequency of the force, in radians a unit of time; null if drawn",
        example=1.0,
        least=0,
        purpose=13,
        heading="frequency",
        dimension="angular_frequency",
    ),
    _in_force(
        name="force_phase",
        words="phase of the force at t = 0",
        column="phase of the force at t = 0; null if drawn",
        default=0.0,
        purpose=14,
        heading="phase",
    ),
    _in_drive(
        name="drive_spring",
        words="stiffness of the spring between the drive and its block; K is without it",
        column="stiffness of the spring of the drive",
        example=2.0,
        least=0,
        is_above=True,
        dimension="stiffness",
    ),
    _in_drive(
        name="drive_speed",
        words="speed of the drive against the ground, in whose frame all motion is, or its course in time; belts then"
        " rest by default",
        column="speed of the drive",
        example=0.1,
        in_time=True,
        dimension="speed",
    ),
    _in_drive(
        name="drive_amplitude",
        words="amplitude of a harmonic part of that speed, amplitude cos(frequency t + phase)",
        column="amplitude of the harmonic part of the drive's speed",
        default=0.0,
        dimension="speed",
    ),
    _in_drive(
        name="drive_frequency",
        words="frequency of that part, in radians a unit of time",
        column="frequency of the harmonic part of the drive's speed",
        default=1.0,
        least=0,
        is_above=True,
        dimension="angular_frequency",
    ),
    _in_drive(
        name="drive_phase",
        words="phase of that part at t = 0",
        column="phase of the harmonic part of the drive's speed at t = 0",
        default=0.0,
    ),
    *(
        Term(
            name=f"weakening_{parameter.name}",
            **parameter.metadata["said"],
            least=0,
            is_above=True,
            part="weakening",
            table="weakening",
            dimension={1: "speed", -1: "slowness"}.get(parameter.metadata["power"], ""),
        )
        for law in LAWS.values()
        for parameter in fields(law)
    ),
)

#: The arguments of `System` among them, a number for each block, which files of K may contain too.
OF_BLOCKS = tuple(term.name for term in TERMS if term.is_argument)
