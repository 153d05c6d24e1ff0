"""n_stick(t) in a terminal: right where it is drawn, absent where it cannot be seen."""

import os
import sys

import numpy as np
import pytest

from stickslip.pipeline import query
from stickslip.workflows import sparkline
from stickslip.workflows.commands import main


def level(lines, t, t_stop):
    """The lowest and highest dot at a time, as shares of the height, read off the characters."""
    rows = [line[6:] for line in lines[:-1]]
    column = min(int(t / t_stop * 2 * len(rows[0])), 2 * len(rows[0]) - 1)
    bits = [[0x01, 0x02, 0x04, 0x40], [0x08, 0x10, 0x20, 0x80]][column % 2]
    dots = [(ord(row[column // 2]) - 0x2800) & bit != 0 for row in rows for bit in bits]
    (set_,) = np.nonzero(dots)
    return 1 - set_.max() / (len(dots) - 1), 1 - set_.min() / (len(dots) - 1)


def test_steps_are_where_they_are():
    t, n_stick = np.array([0.0, 25.0, 75.0]), np.array([0, 30, 10])
    lines = sparkline.draw(t, n_stick, 100.0, width=20, height=4)
    assert [line[:5].strip() for line in lines] == ["30", "", "", "0", ""]
    assert lines[-1].split() == ["0", "t", "=", "100"]
    assert {len(line) for line in lines} == {26}
    assert level(lines, 10.0, 100.0) == (0.0, 0.0)
    assert level(lines, 50.0, 100.0) == (1.0, 1.0)
    assert level(lines, 90.0, 100.0) == pytest.approx((1 / 3, 1 / 3), abs=0.5 / 15)


def test_a_short_excursion_is_not_lost():
    t, n_stick = np.array([0.0, 50.1, 50.2]), np.array([10, 0, 10])
    lines = sparkline.draw(t, n_stick, 100.0, width=10, height=3)
    assert level(lines, 50.15, 100.0) == (0.0, 1.0)


@pytest.mark.parametrize("n_stick", [[0], [7]])
def test_what_does_not_change(n_stick):
    lines = sparkline.draw(np.array([0.0]), np.array(n_stick), 5.0)
    assert level(lines, 2.0, 5.0) == ((0.0, 0.0) if n_stick == [0] else (1.0, 1.0))


def pretend(monkeypatch, is_terminal, columns):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: is_terminal, raising=False)
    monkeypatch.setattr(sparkline.shutil, "get_terminal_size", lambda: os.terminal_size((columns, 24)))


def test_on_a_terminal_the_newest_member_is_drawn(dataset, monkeypatch, capsys):
    pretend(monkeypatch, True, 80)
    assert main(["status", str(dataset), "--plot"]) == 0
    lines = capsys.readouterr().out.splitlines()
    (head,) = (i for i, line in enumerate(lines) if line.startswith("n_stick of "))
    t, n_stick = query.n_stick(dataset, lines[head].removeprefix("n_stick of "))
    assert lines[head + 1 :] == sparkline.draw(t, n_stick, 40.0)
    assert main(["status", str(dataset)]) == 0
    assert "n_stick" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("is_terminal", "columns", "is_seen"), [(True, 80, True), (True, 40, False), (False, 80, False)]
)
def test_nothing_is_drawn_where_it_cannot_be_seen(is_terminal, columns, is_seen, dataset, monkeypatch, capsys):
    pretend(monkeypatch, is_terminal, columns)
    assert bool(sparkline.newest(dataset)) is is_seen
    assert main(["status", str(dataset), "--plot"]) == 0
    why = f"the terminal has {columns} columns, fewer than 69" if is_terminal else "this is no terminal"
    assert capsys.readouterr().err == ("" if is_seen else f"plot    not drawn: {why}\n")
