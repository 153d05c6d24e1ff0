"""What the text claims beside its figures, in words and as the rows of tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from stickslip.workflows.paper import figures as paper_figures
from stickslip.workflows.paper.claims import APART, FOLLOWED, Survival
from stickslip.workflows.paper.measure import Measured
from stickslip.workflows.paper.scene import PaperScene
from stickslip.workflows.paper.words import counted, number, share


@dataclass(frozen=True)
class Claim:
    """One claim counted: a row of the table `claims`.

    `found` of `tried` have what the claim says, or, of a claim that something never happens, contradict it;
    null where `value` is measured instead.
    """

    claim: str
    n: int
    tried: int
    found: int | None = None
    low: float | None = None
    high: float | None = None
    value: float | None = None


def claims(measured: Measured) -> list[Claim]:
    """The rows of the table `claims`."""
    found = []
    if measured.uniqueness:
        worst = max(pair.apart for pair in measured.uniqueness) / APART
        found.append(
            Claim("forward uniqueness: distance over distance at start", 2, len(measured.uniqueness), value=worst)
        )
    for one in measured.one_block:
        if one.n_exits:
            _, low, high = share(one.n_again, one.n_exits)
            found.append(Claim("one block sticks again after its exit", 1, one.n_exits, one.n_again, low, high))
    for name, count in (("all-slip state linearly stable", "stable"), ("diverged", "diverged")):
        for row in measured.survival:
            _, low, high = share(getattr(row, count), row.n_draws)
            found.append(Claim(name, row.n, row.n_draws, getattr(row, count), low, high))
    return found


def claim_words(scene: PaperScene, measured: Measured) -> list[str]:
    """The claims in words, each with its counts."""
    words = []
    if measured.uniqueness:
        apart = max(pair.apart for pair in measured.uniqueness)
        growth = apart / APART
        close = "stay together" if growth < 10 else "come apart"
        words.append(
            f"Forward uniqueness: {len(measured.uniqueness)} runs of two blocks that start {APART:g} from one"
            f" through the double exit {{+, +}}, from all sides, {close}: at most {apart:.2g} apart up to"
            f" t = {FOLLOWED:g}, {growth:.2g} times the distance at the start. For μ ≥ 0 solutions are unique"
            " in forward time; exits whose outcome is open need a law that loses monotonicity."
        )
    for one in measured.one_block:
        verb = "never sticks again" if one.n_again == 0 else f"sticks again in {one.n_again}"
        words.append(
            f"One block: of {one.n_blocks} with random constants and starts {one.n_exits} stick and exit; after its"
            f" exit a block {verb}{': no cycle of stick and slip' if one.n_again == 0 and one.n_exits else ''}."
        )
    if measured.survival:
        rows = measured.survival
        stable = ", ".join(f"{row.stable} of {row.n_draws} at n = {row.n}" for row in rows)
        words.append(f"The state in which all slip is linearly stable in {stable}.")
        gone = [f"{counted(row.diverged, row.n_draws)} at n = {row.n}" for row in rows if row.diverged]
        escape = f"Escape to infinity by t = {scene.survival_t_end:g}: {', '.join(gone) or 'in no draw'}."
        words.append(escape + (" A run that is sustained so far need not be bounded." if gone else ""))
        words.append(survival_words(rows, scene.survival_t_end))
    if measured.certificate:
        words.append(certificate_words(measured))
    return words


def survival_words(rows: Sequence[Survival], t_end: float) -> str:
    """The survival curve in words, the fates kept apart."""
    total = {
        name: sum(getattr(row, name) for row in rows) for name in ("certified", "silent", "sustained", "diverged")
    }
    words = (
        f"Fates of {sum(row.n_draws for row in rows)} draws at t = {t_end:g}: {total['certified']} at rest by"
        f" certificate, {total['silent']} silent without one, {total['sustained']} sustained, {total['diverged']}"
        " diverged"
    )
    failed = sum(row.failed for row in rows)
    words += f", {failed} failed" if failed else ""
    unstable = total["silent"] - sum(row.stable_silent for row in rows)
    if total["silent"]:
        words += (
            f"; of the silent, {unstable} have an unstable all-slip state, from which they may yet be driven back"
        )
    odd = sum(row.stable_moving for row in rows)
    words += f"; {number(odd)} of the linearly stable draws still move{'s' if odd == 1 else ''}"
    return f"{words}."


def certificate_words(measured: Measured) -> str:
    """False alarms and lateness of the certificate."""
    some = [row for row in measured.certificate if row.t_certified is not None]
    if not some:
        return f"Certificate: none of {len(measured.certificate)} runs was certified."
    alarms = sum(bool(row.n_after) for row in some)
    late = [row.t_certified - row.t_last for row in some if row.t_certified is not None and row.t_last is not None]
    _, _, high = share(alarms, len(some))
    words = (
        f"Certificate: {len(some)} of {len(measured.certificate)} runs were certified; continued without it,"
        f" {number(alarms)} of them had a further event (at most {100 * high:.1f}% by the interval)"
    )
    if late:
        words += (
            f"; it came {median(late):,.0f} units of time after the last event in the median,"
            f" {max(late):,.0f} at most"
        )
    return f"{words}."


def lateness(measured: Measured) -> list[dict[str, Any]]:
    """The certificate by n: rows of the page's table."""
    rows = []
    for n in dict.fromkeys(row.n for row in measured.certificate):
        some = [row for row in measured.certificate if row.n == n]
        late = sorted(
            row.t_certified - row.t_last for row in some if row.t_certified is not None and row.t_last is not None
        )
        rows.append({
            "n": n, "runs": len(some), "certified": sum(row.t_certified is not None for row in some),
            "alarms": sum(bool(row.n_after) for row in some), "median": median(late) if late else None,
            "most": late[-1] if late else None,
        })  # fmt: skip
    return rows


def shares(rows: Sequence[Survival], name: str) -> list[paper_figures.Share]:
    """The share of one fate at each n."""
    return [paper_figures.Share(row.n, *share(getattr(row, name), row.n_draws)) for row in rows]
