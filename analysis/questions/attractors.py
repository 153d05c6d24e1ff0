"""What runs settle on: the share of each kind of attractor, and the periods of cycles."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter

from stickslip.analysis.answer import Answer, F, I, Question, Row, S, frame, named
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.style import BLUE, GREEN, GREY, ORANGE, PURPLE, panel

#: The kinds, in the order of pictures and tables: see `stickslip.sim.attractors`.
KINDS = {
    "rest": "at rest",
    "sliding": "slide steadily",
    "periodic": "periodic",
    "irregular": "irregular",
    "escaping": "run away",
    "undecided": "undecided",
}
NO_RECORD = "no record"  # in this ensemble
NONE_EXACT = "none exact"  # no run that has one
_COLOURS = dict(zip(KINDS, (BLUE, GREEN, ORANGE, PURPLE, "black", GREY), strict=True))
_MOST_BARS = 24
_SCHEMA = {
    "group": S, "attractor": S, "n_runs": I, "of": I, "share": F, "share_low": F, "share_high": F,
    "period_least": F, "period_median": F, "period_most": F,
}  # fmt: skip


def answer(study: Study) -> Answer | None:
    if "attractor" not in study.data.members:
        return Answer(lack=NO_RECORD) if "attractors" in study.settings.question else None
    found = {group.label: _of_group(study, group) for group in study.groups}
    found = {label: rows for label, rows in found.items() if rows}
    if not found:
        return Answer(lack=NONE_EXACT)
    rows = [row for some in found.values() for row in some]
    facts = {
        "groups": [{"group": label, "of": some[0]["of"], "rows": some} for label, some in found.items()],
        "rows": rows, "kinds": KINDS, "t_burn": study.settings.t_burn,
        "n_undecided": sum(row["n_runs"] for row in rows if row["attractor"] == "undecided"),
        "n_runs": sum(some[0]["of"] for some in found.values()), "most_bars": _MOST_BARS,
    }  # fmt: skip
    shares = {label: {row["attractor"]: row["share"] for row in some} for label, some in found.items()}
    drawn = dict(list(shares.items())[:_MOST_BARS])
    return Answer(facts, tables={"attractors": frame(_SCHEMA, rows)}, figures={"attractors": partial(_bars, drawn)})


def _of_group(study: Study, group: Group) -> list[Row]:
    """A row for each kind that occurs in a group: its share of the runs that have one."""
    runs = group.members[group.members["attractor"].notna()]
    _, periods = study.data.recorded["period"]
    rows = []
    for kind in KINDS:
        has = runs["attractor"] == kind
        if not has.any():
            continue
        share = study.share(group, dict(zip(runs["member_id"], has, strict=True)))
        row: dict[str, Any] = {
            "group": group.label, "attractor": kind, "n_runs": int(has.sum()), "of": len(runs),
            **named("share", share),
        }  # fmt: skip
        known = [float(one) for name in runs["member_id"][has] if (one := periods[name]) is not None]
        least, median, most = np.percentile(known, (0, 50, 100)).tolist() if known else 3 * [None]
        rows.append(row | {"period_least": least, "period_median": median, "period_most": most})
    return rows


@panel()
def _bars(ax: Axes, shares: dict[str, dict[str, float]]) -> None:
    """A stacked bar a group, from below in the order of the page."""
    labels: Sequence[str] = list(shares)[::-1]
    left = np.zeros(len(labels))
    for kind, words in KINDS.items():
        width = np.array([shares[label].get(kind, 0.0) for label in labels])
        if width.any():
            ax.barh(labels, width, left=left, color=_COLOURS[kind], label=words)
        left += width
    ax.set(xlim=(0, 1), xlabel="share of runs")
    ax.xaxis.set_major_formatter(PercentFormatter(1.0))
    ax.legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1))


QUESTION = Question(answer, rank=2, beside=("fates",))
