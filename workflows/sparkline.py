"""n_stick(t) as a few lines of text, for a terminal."""

from __future__ import annotations

import shutil
import sys

import numpy as np
import pyarrow.compute as pc

from stickslip.pipeline.dataset import dataset, reading
from stickslip.pipeline.ledger import read_commits, read_manifest
from stickslip.pipeline.storage import Where

#: The dots of a braille character, two columns of four from the top, as bits of its code.
_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
_BLANK = 0x2800

_WIDTH, _HEIGHT = 60, 4  # characters
_COLUMNS = _WIDTH + 9  # of a terminal that it fits in, with its labels


def obstacle() -> str:
    """Why a drawing would not be seen; "" if it would."""
    if not sys.stdout.isatty():
        return "this is no terminal"
    columns = shutil.get_terminal_size().columns
    if columns < _COLUMNS:
        return f"the terminal has {columns} columns, fewer than {_COLUMNS}"
    takes_unicode = (sys.stdout.encoding or "").lower().startswith("utf")
    return "" if takes_unicode else f"the terminal takes {sys.stdout.encoding}, and no Unicode"


def newest(path: Where) -> list[str]:
    """n_stick(t) of the member committed last, drawn and labelled.

    Nothing if there is none that did not fail, or if there is an `obstacle`.
    """
    if obstacle():
        return []
    kept = read_manifest(path).shards
    names = [commit.name for commit in read_commits(path) if commit.name in kept]
    if not names:
        return []
    with reading(path):
        source = dataset(path, names[-1:])
        rows = source.to_table(["member_id", "t", "n_stick", "t_stop"], filter=pc.field("n_stick").is_valid())
    if rows.num_rows == 0:
        return []
    last = rows.slice(rows.num_rows - 1).to_pylist()[0]
    return [f"n_stick of {last['member_id']}", *draw(np.array(last["t"]), np.array(last["n_stick"]), last["t_stop"])]


def draw(t: np.ndarray, n_stick: np.ndarray, t_stop: float, width: int = _WIDTH, height: int = _HEIGHT) -> list[str]:
    """A step function on [t[0], t_stop] in braille, with its greatest value, 0 and the ends of time beside it.

    Parameters
    ----------
    t, n_stick : ndarray, shape (m,)
        n_stick[k] >= 0 holds on [t[k], t[k+1]), the last to `t_stop`.
    width, height : int
        Of the drawing, in characters.
    """
    columns, rows = 2 * width, 4 * height
    top = max(int(n_stick.max()), 1)
    level = np.rint((rows - 1) * (1 - n_stick / top)).astype(int)  # 0 is the top row
    edges = np.linspace(t[0], t_stop, columns + 1)
    first = np.searchsorted(t, edges[:-1], side="right") - 1
    last = np.maximum(np.searchsorted(t, edges[1:], side="left") - 1, first)
    dots = np.zeros((rows, columns), dtype=bool)
    for j in range(columns):  # all that a column's span of time takes, so that no short excursion is lost
        seen = level[first[j] : last[j] + 1]
        dots[seen.min() : seen.max() + 1, j] = True
    codes = (dots.reshape(height, 4, width, 2) * _DOTS[:, None, :]).sum(axis=(1, 3))
    lines = ["".join(chr(_BLANK + int(code)) for code in row) for row in codes]
    labels = [f"{top:>5}", *["     "] * (height - 2), f"{0:>5}"]
    start, stop = f"{t[0]:g}", f"t = {t_stop:g}"
    drawn = [f"{label} {line}" for label, line in zip(labels, lines, strict=True)]
    return [*drawn, f"      {start}{stop:>{width - len(start)}}"]
