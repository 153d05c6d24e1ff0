"""Alerts: a closed table of what a reader must know before believing a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from stickslip.analysis.members import Proofs


class Code(Enum):
    """What may be wrong: the rank, by which alerts are sorted, and the words, with the names of their numbers.

    Rank 1 says what makes numbers wrong, 2 what they refer to, 3 what weakens them.
    """

    FAILED = 1, "{n:,} of {of:,} runs failed and are left out."
    DRIFT = 1, "{what}{where} still drifts after t_burn = {t_burn:g}: lengthen the runs, and raise t_burn."
    DIVERGED = 2, "Motion grew without limit in {n:,} of {of:,} runs{where}; means after t_burn are of the others."
    SETTLED = 2, "{n:,} of {of:,} runs ended in steady sliding; {what} is of the others."
    NOT_MOVING = 2, "{n:,} of {of:,} runs are not in motion; {what} is of the others."
    MISFIT = 3, "A damped oscillator misses the slow spectrum{where} (p-value {p}{among}): period and Q are rough."
    UNCERTIFIED = 2, "{n:,} of {of:,} runs slide but may stick again: {why}."
    WITHOUT = 2, "{n:,} of {of:,} runs have no {what} and are left out there: {why}."
    WITHHELD = 2, "{what} is not given at {n} of {of} points: {why}."
    TEMPORARY = 2, "{n:,} of {of:,} runs slide but will stick again: their sliding is unstable."
    UNDECIDED = 2, "{n:,} of {of:,} runs are undecided; the column attractor_reason says why."
    FEW = 3, "Only {n} {units}: intervals are wide."
    OVERLAP = (
        1,
        "Some block is slipping {share} of the time ({where}), so overlapping episodes count as one: slow the belt.",
    )
    BLURRED = 1, "{what}: creeping blocks may count as stuck, so episodes are not counted."
    SPANNING = 2, "{share} of the episodes take all {n} blocks: their sizes are those of the chain."
    BENDS = 2, "b depends on its range{where}: on upper parts it goes from {first} to {last} (table episode_b)."
    ONE_SYSTEM = 2, "One system, many starts: intervals are over starts of this system."

    @property
    def rank(self) -> int:
        """Its place among others."""
        return int(self.value[0])

    @property
    def words(self) -> str:
        """Its text, with the names of its numbers in braces."""
        return str(self.value[1])


@dataclass(frozen=True)
class Alert:
    """An alert: its code, and the numbers in its words."""

    code: Code
    numbers: tuple[tuple[str, int | float | str], ...] = ()

    @classmethod
    def of(cls, code: Code, **numbers: int | float | str) -> Alert:
        """From the numbers of its words, by name."""
        return cls(code, tuple(numbers.items()))

    @property
    def subject(self) -> tuple[Code, tuple[int | float | str, ...]]:
        """What it is about: alerts that differ in their setting alone are one."""
        return self.code, tuple(value for name, value in self.numbers if name != "where")

    def __str__(self) -> str:
        return self.code.words.format(**dict(self.numbers))


def uncertified(n: int, of: int, proofs: Proofs) -> Alert:
    """The alert that runs slide without a proof that they go on so."""
    return Alert.of(Code.UNCERTIFIED, n=n, of=of, why=proofs.value)


def drift(what: str, settings: Sequence[str], t_burn: float) -> Alert:
    """The alert that something drifts at some settings: which one, or how many."""
    where = f" ({settings[0]})" if len(settings) == 1 else f" at {len(settings)} settings"
    return Alert.of(Code.DRIFT, what=what, where=where, t_burn=t_burn)
