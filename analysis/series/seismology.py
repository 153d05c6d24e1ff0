"""Episodes as a catalogue of earthquakes, for tools of seismology."""

from __future__ import annotations

import numpy as np
import pandas as pd

#: Columns that a catalogue needs.
_NEEDED = ("start", "moment", "first_block")


def catalogue(episodes: pd.DataFrame, seconds: float = 1.0) -> pd.DataFrame:
    """Episodes as a catalogue with the columns that ObsPy reads and writes in CSV.

    Parameters
    ----------
    episodes : DataFrame
        One row an episode or a cluster: start, moment, first_block, and member_id if several runs are in it; perhaps
        end, size and stress_drop.
    seconds : float
        A unit of time in seconds.

    Returns
    -------
    DataFrame
        id; time, in UTC since 1970; lat and dep, which are zero; lon, the number of the block that left first, in
        thousandths of a degree; mag, log10 of the absolute moment; magtype. Then, in the units of `episodes`,
        member_id, origin (the start), nucleation (the block), moment and, if known, extent (in blocks), duration and
        stress_drop. Episodes whose moment is zero have no magnitude and are left out.

    Raises
    ------
    TypeError, ValueError
        If `episodes` is not a DataFrame, lacks one of the columns, or a start or a moment is not finite.
    """
    if not isinstance(episodes, pd.DataFrame):
        raise TypeError(
            f"episodes: expected a DataFrame with the columns {', '.join(_NEEDED)}, got"
            f" {type(episodes).__name__}; write e.g. pd.DataFrame({{name: getattr(quakes, name) for name in (...)}})"
        )
    if lacking := [name for name in _NEEDED if name not in episodes]:
        raise ValueError(
            f"episodes: expected the columns {', '.join(_NEEDED)}, found no {', '.join(lacking)} in"
            f" {', '.join(map(str, episodes))}; `Dataset(...).episodes` has them"
        )
    for name in ("start", "moment"):
        if not (is_known := np.isfinite(episodes[name].to_numpy(np.float64, na_value=np.nan))).all():
            row = episodes.index[np.flatnonzero(~is_known)[0]]
            raise ValueError(f"episodes: expected a finite {name} in each row, got none in row {row}; leave it out")
    moving = episodes[episodes["moment"] != 0]
    member = moving["member_id"] if "member_id" in moving else pd.Series("run", index=moving.index)
    columns = {
        "id": member.astype(str) + "-" + moving.groupby(member, sort=False).cumcount().astype(str),
        "time": pd.to_datetime(moving["start"] * seconds, unit="s", utc=True),
        "lat": 0.0,
        "lon": moving["first_block"] / 1000,
        "dep": 0.0,
        "magtype": "M",
        "mag": np.log10(moving["moment"].abs()),
        "member_id": member,
        "origin": moving["start"],
        "nucleation": moving["first_block"],
        "moment": moving["moment"],
    }
    if "end" in moving and "elapsed" not in moving:  # that of adiabatic loading takes no time of the belt
        moving = moving.assign(elapsed=moving["end"] - moving["start"])
    further = {"extent": "size", "duration": "elapsed", "stress_drop": "stress_drop"}
    columns |= {column: moving[name] for column, name in further.items() if name in moving}
    return pd.DataFrame(columns).reset_index(drop=True)
