"""Findings: the closed set of what a report can say.

A finding is a quantity, its estimate with an interval, where it holds, and at most one comparison. The sentence on
the page, the row of a table, the line in a terminal and the entry of ``report/findings.json`` all come from it, and
from nothing else: `findings.words` says each kind, `levels` lays each out as rows.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import Enum, StrEnum
from typing import Any, NamedTuple, TypeAlias

from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.stats.estimates import Estimate
from stickslip.pipeline.design.units import Units
from stickslip.pipeline.design.values import Amount


class Form(Enum):
    """How the values of a quantity are written."""

    NUMBER = "number"
    COUNT = "count"  #: a whole number
    SHARE = "share"  #: in per cent
    POINTS = "points"  #: a difference of shares, in percentage points


class Scale(StrEnum):
    """What a difference is measured in."""

    RELATIVE = "relative"  #: to what it is compared with
    ABSOLUTE = "absolute"  #: the units of the quantity; percentage points of a share


@dataclass(frozen=True)
class Quantity:
    """A quantity.

    Attributes
    ----------
    key : str
        Its name in files.
    name : str
        A noun phrase in the singular, without article: "mean number of sticking blocks".
    form : Form
    more, less : str
        What it is beside something smaller, and beside something larger: "longer", "shorter".
    definition : str
        What it is, in a sentence; empty where the name says it.
    things : str
        What it is a rate or a mean number of: "slip onsets"; empty of any other.
    clause : str
        How its level is said where that is no noun and number, with {} for the estimate or, where a difference is
        shown, for the comparison: "small differences grow e-fold in {} time units".
    dimension : str
        Of `stickslip.pipeline.design.units.DIMENSIONS`; empty: none.
    unit : str
        What follows its values; set by `in_units`.
    """

    key: str
    name: str
    form: Form = Form.NUMBER
    more: str = "above"
    less: str = "below"
    definition: str = ""
    clause: str = ""
    things: str = ""
    dimension: str = ""
    unit: str = ""

    def measured(self, units: Units) -> Quantity:
        """The same in the units of data."""
        unit = units.of(self.dimension)
        name, clause = self.name.removesuffix(PER_TIME), self.clause.removesuffix(TIME_UNITS)
        return replace(self, unit=unit, name=name, clause=clause) if unit else self


#: What ends the name of a rate, and the clause of a time, that has no unit.
PER_TIME, TIME_UNITS = ", per unit of time", " time units"


def in_unit(value: str, unit: str) -> str:
    """A value with its unit, if it has one."""
    return f"{value} {unit}" if unit else value


def in_units(said: Any, units: Units) -> Any:
    """A finding, or a part of one, whose quantities have their units."""
    if isinstance(said, Quantity | Place | KeyChange):
        return said.measured(units)
    if isinstance(said, Threshold | Attracting):
        said = replace(said, unit=units.of_key(said.key))
    if type(said) is tuple:  # a named one has no quantity
        return tuple(in_units(part, units) for part in said)
    if not is_dataclass(said) or isinstance(said, type) or not units:
        return said
    return replace(
        said, **{entry.name: in_units(getattr(said, entry.name), units) for entry in fields(said) if entry.init}
    )


class Verdict(StrEnum):
    """What the interval of a difference comes to."""

    MORE = "more"
    LESS = "less"
    EQUAL = "equal"  #: within the margin that the scene declares
    SAME = "same"  #: in every unit, to the accuracy of the runs
    OPEN = "no difference shown"
    OPEN_AMONG_MANY = "no difference shown among so many comparisons"
    UNJUDGED = "no interval"


class Family(NamedTuple):
    """The comparisons that a difference is judged together with, and its p-value adjusted for their number."""

    n: int
    p_different: float
    alpha: float = 0.05


@dataclass(frozen=True)
class Difference:
    """How far an estimate lies from what it is compared with.

    Attributes
    ----------
    estimate : Estimate
        In units of `scale`, positive if the estimate is the larger one.
    scale : Scale
    margin : float, optional
        The largest difference, in the same units, that the scene declares to be none.
    family : Family, optional
    is_same : bool
        Whether each unit has the same value in both, to the accuracy of its run.
    """

    estimate: Estimate
    scale: Scale = Scale.RELATIVE
    margin: float | None = None
    family: Family | None = None
    is_same: bool = False

    @property
    def verdict(self) -> Verdict:
        """By the interval; in a family a difference is shown only if the adjusted p-value is below its level too."""
        low, high = self.estimate.low, self.estimate.high
        if self.is_same:
            return Verdict.SAME
        if low is None or high is None:
            return Verdict.UNJUDGED
        if self.margin is not None and -self.margin < low <= high < self.margin:
            return Verdict.EQUAL
        if low <= 0.0 <= high:
            return Verdict.OPEN
        if self.family is not None and self.family.p_different >= self.family.alpha:
            return Verdict.OPEN_AMONG_MANY
        return Verdict.MORE if low > 0.0 else Verdict.LESS

    @property
    def side(self) -> Verdict:
        """The verdict; of what is within the margin on which side of zero it is, if the interval excludes zero."""
        side = replace(self, margin=None, family=None).verdict
        return side if self.verdict is Verdict.EQUAL and side is not Verdict.OPEN else self.verdict


@dataclass(frozen=True)
class Comparison:
    """With what an estimate is compared, as a noun phrase ("a fair coin's ln 2"), and how far from it it lies.

    Without a difference the estimate itself is a distance from it. `value` is its own, where no other finding says
    that.
    """

    other: str
    difference: Difference | None = None
    value: Estimate | None = None


@dataclass(frozen=True)
class Basis:
    """What an estimate rests on: a number of independent units, and the noun for one of them."""

    n: int
    unit: str = "system"


@dataclass(frozen=True)
class Level:
    """The value of a quantity at a setting.

    Attributes
    ----------
    where : Place
        What tells the setting from the others.
    """

    quantity: Quantity
    estimate: Estimate
    where: Place = EVERYWHERE
    comparison: Comparison | None = None
    basis: Basis | None = None

    @property
    def difference(self) -> Difference | None:
        """How far it lies from what it is compared with; None where nothing is, or it is a distance itself."""
        return None if self.comparison is None else self.comparison.difference


class KeyChange(NamedTuple):
    """A key and two of its values; `is_of_size`: both are negative, and said by their sizes."""

    key: str
    first: str
    second: str
    is_of_size: bool = False
    unit: str = ""  #: of both; set by `in_units`

    def measured(self, units: Units) -> KeyChange:
        """The same in the units of data."""
        has_unit = isinstance(self.first, Amount) and isinstance(self.second, Amount)
        return self._replace(unit=units.of_key(self.key) if has_unit else "")

    @property
    def said(self) -> KeyChange:
        """As a sentence has it: |belt_speed| from 0.2 to 0.1."""
        if not self.is_of_size:
            return self
        first, second = (end.removeprefix("-") for end in (self.first, self.second))
        return self._replace(key=f"|{self.key}|", first=first, second=second)


class Course(StrEnum):
    """What a quantity has where it turns along a key."""

    MINIMUM = "minimum"
    MAXIMUM = "maximum"


@dataclass(frozen=True)
class Turn:
    """That a quantity turns between the ends of a key, the value there, and where that is."""

    course: Course
    estimate: Estimate
    near: Place


@dataclass(frozen=True)
class Change:
    """How a quantity changes from one value of a key to another.

    Attributes
    ----------
    keys : tuple of KeyChange
        What is swept, of keys that are swept together each.
    before, after : Estimate
        The quantity at these.
    where : Place
        At which values of the other keys, or averaged over which.
    turns : tuple of Turn
        Where it is shown to turn on the way, in order.
    """

    quantity: Quantity
    keys: tuple[KeyChange, ...]
    before: Estimate
    after: Estimate
    difference: Difference
    where: Place = EVERYWHERE
    basis: Basis | None = None
    turns: tuple[Turn, ...] = ()


@dataclass(frozen=True)
class Share:
    """The share of some things of which something holds.

    Attributes
    ----------
    things : str
        In the plural: "starts", "runs".
    predicate : str
        A verb phrase in the plural: "end in steady sliding".
    n : int, optional
        How many things there are.
    """

    key: str
    things: str
    predicate: str
    estimate: Estimate
    where: Place = EVERYWHERE
    comparison: Comparison | None = None
    basis: Basis | None = None
    n: int | None = None


@dataclass(frozen=True)
class Lifetime:
    """The median time until something ends, which the end of a run may cut off; a `Share` if it is not reached."""

    quantity: Quantity
    estimate: Estimate
    where: Place = EVERYWHERE
    comparison: Comparison | None = None
    basis: Basis | None = None


class Fit(StrEnum):
    """Whether data are what a law says."""

    HOLDS = "holds"  #: no departure is shown, or one within the margin that the scene declares
    CLOSE = "close"  #: nearer to it than to another; `Law.departure` says how near
    FAILS = "fails"
    OPEN = "open"


@dataclass(frozen=True)
class Law:
    """A law that something follows, how well, and its parameter.

    Attributes
    ----------
    subject : str
        In the plural: "cascade sizes".
    predicate : str
        A verb phrase in the plural: "fall off exponentially".
    parameter : Level
    fit : Fit
    departure : Level, optional
        How far the data are from the law.
    nearly : str
        The predicate of what is `Fit.CLOSE`; by default "nearly", and the predicate.
    called : str
        What the parameter is called beside the subject; by default the name of its quantity.
    scope : Level, optional
        The share of the things that the law is of, where it is not of all; `things` are these in the plural.
    """

    subject: str
    predicate: str
    parameter: Level
    fit: Fit = Fit.HOLDS
    departure: Level | None = None
    nearly: str = ""
    called: str = ""
    scope: Level | None = None
    things: str = ""


@dataclass(frozen=True)
class Parts:
    """A value as the sum of its parts, the last of which is the one that is asked about.

    `subject` is what the parts raise or lower, where the whole is an excess of it; by default the whole.
    """

    whole: Level
    parts: tuple[Level, ...]
    subject: str = ""


@dataclass(frozen=True)
class Alike:
    """A value that all of some things share, to the accuracy of the runs: no interval belongs to it."""

    quantity: Quantity
    value: float
    among: str
    where: Place = EVERYWHERE
    basis: Basis | None = None


@dataclass(frozen=True)
class Outcomes:
    """Settings grouped by the outcome of a comparison.

    Attributes
    ----------
    other : str
        What they are compared with: "the exact engine".
    equal, different, undecided : tuple of str
        The settings of each outcome ("h = 0.1 and less").
    largest : Level, optional
        The largest difference.
    at_largest : str
        The setting of the largest difference.
    others : tuple of str
        The settings that differ, beside that of the largest difference.
    second : Difference, optional
        In the same quantity, that of the only other setting that differs.
    scope : str
        In what they are compared, where not in all that is recorded: "the number of sticking blocks".
    where : Place
        What all of them share, where a page has other settings.
    """

    other: str
    equal: tuple[str, ...] = ()
    different: tuple[str, ...] = ()
    undecided: tuple[str, ...] = ()
    largest: Level | None = None
    at_largest: str = ""
    others: tuple[str, ...] = ()
    second: Difference | None = None
    scope: str = ""
    where: Place = EVERYWHERE


@dataclass(frozen=True)
class Threshold:
    """Between which values of a key something ends in all units, or begins in all.

    Attributes
    ----------
    subject : str
        "stick-slip".
    last, first : str
        The last value before, and the first value after.
    """

    subject: str
    is_end: bool
    key: str
    last: str
    first: str
    where: Place = EVERYWHERE
    basis: Basis | None = None
    unit: str = ""  #: of the key; set by `in_units`

    @property
    def stretch(self) -> str:
        """The values of the key between which it lies."""
        return in_unit(f"{self.last} to {self.first}", self.unit)


@dataclass(frozen=True)
class Regime:
    """Settings at which all of some things do the same, or do the same several things.

    Attributes
    ----------
    key : str
        The first outcome.
    things : str
        In the plural: "starts".
    predicates : tuple of str
        Verb phrases in the plural, one for each outcome: "slide steadily".
    n, of : int
        How many things have the first outcome there, and how many there are.
    share : Estimate
        Of the first outcome: the share of such things that have it; without an interval of few units.
    where : Place
        Which settings: "belt_speed = 5 to 7".
    is_of_each : bool
        Whether the share is that at each of several settings.
    """

    key: str
    things: str
    predicates: tuple[str, ...]
    n: int
    of: int
    share: Estimate = field(default_factory=Estimate)
    where: Place = EVERYWHERE
    basis: Basis | None = None
    is_of_each: bool = False


class Bound(StrEnum):
    """How the end of a stretch of a key is known."""

    SETTING = "setting"  #: the last value that was run
    FOLLOWED = "the last value to which it was followed"  #: no run begins there; it may attract beyond
    STABILITY = "linear stability"  #: an eigenvalue of steady sliding crosses
    MULTIPLIER = "instability of the cycle"  #: its multiplier comes to 1
    GRAZING = "grazing of the cycle"  #: a block of it only touches its belt's speed
    CYCLE = "loss of the cycle"  #: it attracts up to there; beyond, a run from it provably settles elsewhere
    RUNS = "runs"  #: to their ends, from one another


@dataclass(frozen=True)
class Attracting:
    """What attracts one system over a stretch of a key.

    Attributes
    ----------
    attractors : tuple of str
        As nouns: "steady sliding".
    low, high : str
        The ends of the stretch.
    horizon : str
        How long the runs are by which an end may be known.
    ends : tuple of Level
        Those ends that are known better than by settings.
    """

    attractors: tuple[str, ...]
    key: str
    low: str
    high: str
    low_by: Bound = Bound.SETTING
    high_by: Bound = Bound.SETTING
    where: Place = EVERYWHERE
    basis: Basis | None = None
    horizon: str = ""
    ends: tuple[Level, ...] = ()
    unit: str = ""  #: of the key; set by `in_units`

    @property
    def stretch(self) -> str:
        """The values of the key."""
        return in_unit(self.low if self.low == self.high else f"{self.low} to {self.high}", self.unit)


class Truth(StrEnum):
    """The answer to a question of yes or no."""

    YES = "Yes"
    NO = "No"
    UNDECIDED = "Undecided"


class Reason(StrEnum):
    """Why there is no answer."""

    FEW_UNITS = "too few independent units for an interval"
    FEW_CASCADES = "too few cascades"
    FEW_BLOCKS = "no cascade has more than two blocks"
    FEW_EPISODES = "too few episodes"
    FEW_EVENTS = "too few events"
    DRIFT = "no steady state"
    NO_MOTION = "no run is in motion"
    SHORT_WINDOW = "the runs are too short"
    MERGED = "slip onsets and arrests of one time step cancel"
    OUT_OF_RANGE = "too few pairs stay in their linear range"
    NOT_SHOWN = "none is shown"
    NO_REFERENCE = "nothing to compare with"
    NOT_RECORDED = "not recorded"
    NO_SHIFT = "blocks cannot be shifted in time: a force or belt repeats too rarely, or all blocks repeat with it"
    NOT_RUN = "not run"
    ALL_FAILED = "all runs failed"
    CREEP = "blocks that creep may count as stuck"
    NOTHING_COUNTED = "nothing to count"
    ONE_VALUE = "all values are the same"
    CODE_FAILED = "its code failed"


@dataclass(frozen=True)
class Lack:
    """What could not be told, as a noun phrase, and why; `detail` has the numbers behind the reason."""

    what: str
    reason: Reason
    detail: str = ""


#: A finding that answers no question of yes or no.
Statement: TypeAlias = (
    Level | Change | Share | Lifetime | Law | Parts | Alike | Outcomes | Regime | Attracting | Threshold | Lack
)


@dataclass(frozen=True)
class Decided:
    """The answer to a question of yes or no, and the finding that it rests on."""

    truth: Truth
    finding: Statement


Finding: TypeAlias = Statement | Decided


def levels(finding: Finding) -> list[Level]:
    """A finding as rows of a table: the values that it states; none of a lack."""
    match finding:
        case Level():
            return [finding]
        case Lifetime(quantity, estimate, where, comparison, basis):
            return [Level(quantity, estimate, where, comparison, basis)]
        case Share(key, things, predicate, estimate, where, comparison, basis):
            return [Level(_share(key, things, predicate), estimate, where, comparison, basis)]
        case Change(quantity, keys, _, after, difference, where, basis):
            key = " with ".join(change.key for change in keys)
            first = " with ".join(in_unit(change.first, change.unit) for change in keys)
            second = " with ".join(in_unit(change.second, change.unit) for change in keys)
            comparison = Comparison(f"{key} = {first}", difference)
            return [Level(quantity, after, Place.key(key, second) + where, comparison, basis)]
        case Law(parameter=parameter, departure=departure, scope=scope):
            return [level for level in (parameter, scope, departure) if level is not None]
        case Parts(whole, parts):
            return [whole, *parts]
        case Alike(quantity, value, among, where, basis):
            place = where if basis is not None else where + Place.words(among)
            return [Level(quantity, Estimate(value), place, basis=basis)]
        case Threshold(subject, is_end, key, where=where, basis=basis):
            quantity = Quantity("threshold", f"where {subject} {'ends' if is_end else 'begins'}")
            return [Level(quantity, Estimate(), Place.key(key, finding.stretch) + where, basis=basis)]
        case Regime(key, things, predicates, _, _, share, where, basis):
            return [Level(_share(key, things, predicates[0]), share, where, basis=basis)]
        case Attracting(attractors, key, where=where, basis=basis):
            quantity = Quantity("attracting", f"where {' and '.join(attractors)} attract")
            return [Level(quantity, Estimate(), Place.key(key, finding.stretch) + where, basis=basis), *finding.ends]
        case Decided(_, reason):
            return levels(reason)
        case Outcomes() | Lack():  # of which contrasts outcomes are is said by findings of their own
            return []


def _share(key: str, things: str, predicate: str) -> Quantity:
    return Quantity(key, f"share of {things} that {predicate}", Form.SHARE)
