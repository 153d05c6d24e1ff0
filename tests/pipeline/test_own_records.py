"""Records by functions of the user's own: what they are given, what is kept of it, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip import sim
from stickslip.pipeline import (
    Scene,
    SceneError,
    StoreError,
    expand,
    extend,
    load_scene,
    parse_scene,
    query,
    run_ensemble,
    run_member,
    verify,
)
from stickslip.pipeline.own import function
from stickslip.pipeline.own.modules import file_of
from stickslip.pipeline.records.own import OwnRecord
from stickslip.pipeline.running.worker import row
from stickslip.workflows.commands import main
from stickslip.workflows.reporting import study_of
from tests.processes import computed_here
from tests.scenes import ENDING

HEAD = "import numpy as np\nfrom typing import Annotated, NamedTuple\nfrom beside import SHIFT\n\n"

#: A record of each type, of events and of states.
MINE = f"""\
from __future__ import annotations

{HEAD}class Measured(NamedTuple):
    events_after: Annotated[int, "events from t_burn on"]
    Share: Annotated[float, "share of blocks that leave from t_burn on", {{"least": 0}}]
    leaves: Annotated[bool, "whether one leaves"]
    busiest: Annotated[str | None, "block with most events, in words", {{"absent": "no event"}}]


def counted(run, system, window) -> Measured:
    since = run.events.t >= window[0]
    blocks = run.events.block[since]
    left = blocks[run.events.mode[since] != 0]
    busiest = f"block {{np.bincount(blocks).argmax() + SHIFT}}" if len(blocks) else None
    return Measured(len(blocks), len(set(left)) / system.n, len(left) > 0, busiest)


class Fast(NamedTuple):
    fastest: Annotated[float, "largest speed at the samples"]
    n_samples: Annotated[int, "their number"]


def fastest(run, system, window, *, samples) -> Fast:
    assert (samples.t[0], samples.t[-1]) == window
    return Fast(np.abs(samples.w).max(), len(samples.t))
"""

SCENE = (
    """\
[system]
coupling = "antisymmetric"
n = [3, 4]
friction = [0.5, 1.0]
[start]
z = -0.7
w = -0.4
[run]
t_end = 12.0
matrices = 3
seed = 1207
[record]
events = true
t_burn = 2.0
own = ["mine:counted", "mine:fastest"]
dt = 0.5
"""
    + ENDING
)


@pytest.fixture
def text():
    return SCENE


def written(folder, text, mine=MINE):
    folder.mkdir(exist_ok=True)
    (folder / "mine.py").write_text(mine)
    (folder / "beside.py").write_text("SHIFT = 0\n")
    (folder / "scene.toml").write_text(text)
    return folder / "scene.toml"


def short(text):
    """The scene with one function, of events, and two members, of three and of four blocks."""
    text = text.replace("friction = [0.5, 1.0]", "friction = 0.5").replace("matrices = 3", "matrices = 1")
    return text.replace('own = ["mine:counted", "mine:fastest"]\ndt = 0.5', 'own = "mine:one"')


def one(lines, returns="float", head=HEAD, note="{}"):
    """A module with one function of one column."""
    body = "".join(f"    {line}\n" for line in lines.splitlines())
    return (
        f'{head}class Measured(NamedTuple):\n    own: Annotated[{returns}, "mine", {note}]\n\n\n'
        f"def one(run, system, window) -> Measured:\n{body}"
    )


def test_what_a_function_measures_is_a_column_like_others(text, tmp_path):
    """Counted again from the events that the dataset keeps, and from runs of `simulate`."""
    scene = load_scene(written(tmp_path, text))
    run_ensemble(scene, tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out").set_index("member_id")
    assert table.own_problem.isna().all()
    assert str(table.leaves.dtype) == "bool"
    for member in expand(scene):
        kept, events = table.loc[member.member_id], query.events(tmp_path / "out", member.member_id)
        since = events.t >= 2.0
        left = {int(block) for block, mode in zip(events.block[since], events.mode[since], strict=True) if mode != 0}
        assert kept.events_after == since.sum()
        assert kept.Share == len(left) / member.n
        assert bool(kept.leaves) == bool(left)
        run = sim.simulate(member.system(), -0.7, -0.4, 12.0, tol=1e-6, t_eval=2.0 + 0.5 * np.arange(21))
        assert kept.fastest == np.abs(run.samples.w).max()
        assert kept.n_samples == len(run.samples.t) == 21
    asked = "SELECT sum(events_after)::BIGINT AS n, count(*) FILTER (leaves) AS k FROM members"
    (found,) = query.sql(tmp_path / "out", asked).itertuples(index=False)
    assert tuple(found) == (table.events_after.sum(), table.leaves.sum())
    assert set(study_of(str(tmp_path / "out")).data.recorded) == {
        "events_after", "Share", "leaves", "fastest", "n_samples",
    }  # fmt: skip


def test_the_bytes_are_the_same_on_workers_and_of_a_scene_that_grew(text, tmp_path, content):
    file = written(tmp_path / "here", text)
    for workers in (0, 1):
        run_ensemble(load_scene(file), tmp_path / f"on_{workers}", workers=workers)
    assert content(tmp_path / "on_0") == content(tmp_path / "on_1")
    assert str(tmp_path) not in (tmp_path / "on_0" / "scene.toml").read_text()
    before = content(tmp_path / "on_0" / "data")
    file.write_text(text.replace("matrices = 3", "matrices = 4"))
    run_ensemble(load_scene(file), tmp_path / "on_0", workers=0)
    assert before.items() < content(tmp_path / "on_0" / "data").items()
    assert verify(tmp_path / "on_0") == []


def test_a_function_does_not_depend_on_what_else_is_recorded(text, tmp_path):
    """Nor does it change what others are given: the arrays of a run cannot be written to."""
    more = text.replace("events = true", "events = true\namplitude = true").replace("dt = 0.5", "dt = 0.5", 1)
    seen = one("return Measured(len(run.samples.t))", "int")
    for name, scene in (
        ("alone", short(text)),
        ("beside", more.replace('"mine:counted", "mine:fastest"', '"mine:one"')),
    ):
        run_ensemble(load_scene(written(tmp_path / name, scene, seen)), tmp_path / f"{name}.out", workers=0)
        assert set(query.members(tmp_path / f"{name}.out").own) == {0}
    for array in ("run.events.t", "run.events.mode", "run.z", "system.damping"):
        spoils = one(f"{array}[:1] = 0\nreturn Measured(1.0)")
        with pytest.raises(SceneError, match="read-only"):
            run_ensemble(load_scene(written(tmp_path, short(text), spoils)), tmp_path / "out", workers=0)


def test_a_scene_without_is_what_it_was(text, tmp_path):
    plain = load_scene(
        written(tmp_path, text.replace('t_burn = 2.0\nown = ["mine:counted", "mine:fastest"]\ndt = 0.5\n', ""))
    )
    assert "own" not in json.dumps(plain.data_keys())
    assert plain.own_record is None
    own = load_scene(written(tmp_path, text))
    assert isinstance(own.own_record, OwnRecord)
    fewer = own.source.replace('own = ["mine:counted", "mine:fastest"]\ndt = 0.5\n', 'own = "mine:counted"\n')
    assert (
        parse_scene(fewer.encode()).hash
        == load_scene(
            written(
                tmp_path, text.replace('own = ["mine:counted", "mine:fastest"]\ndt = 0.5\n', 'own = "mine:counted"\n')
            )
        ).hash
    )
    again = own.changed(run={"matrices": 1})
    assert again.recording.columns == own.recording.columns
    assert own.changed(record={"own": None, "dt": None, "t_burn": None}).hash == plain.hash


def test_a_scene_of_python_may_have_one_and_what_it_prints_is_beside_the_answer(tmp_path, monkeypatch, capsys):
    written(tmp_path, "", one("print('seen')\nreturn Measured(system.n)"))
    monkeypatch.chdir(tmp_path)
    scene = Scene(
        system={"coupling": "antisymmetric", "n": 3},
        start="rest",
        run={"t_end": 5.0, "matrices": 1},
        engine={"name": "coulomb"},
        record={"own": "mine:one"},
        analysis={"t_burn": 1.0, "dt": 0.5},
    )
    assert run_member(scene, expand(scene)[0].member_id)["own"] == 3.0
    assert capsys.readouterr() == ("", "seen\n")


# ---------------------------------------------------------------------------------------------- what goes wrong

#: What goes wrong in a function with the members of four blocks alone, by its name, and words of the reason.
SOME = {
    "raises": ("raise KeyError('a\\nb')", "KeyError: 'a\\nb'"),
    "shows": ("raise ValueError(object())", "ValueError: <object object at 0x...>"),
    "nan": ("return Measured(float('nan'))", "expected a finite number for own, got nan"),
    "infinite": ("return Measured(10**400)", "expected a finite number for own, got inf"),
    "below": ("return Measured(-3)", "expected at least -2.5 for own, got -3"),
    "text": ("return Measured('wide')", "expected a number for own, got str"),
    "truth": ("return Measured(True)", "expected a number for own, got bool"),
    "none": ("return Measured(None)", "expected a number for own, got NoneType"),
    "longer": ("return (1.0, 2.0)", "expected (own), got tuple of 2"),
    "no_tuple": ("return 1.0", "expected (own), got float"),
    "exits": ("raise SystemExit(3)", "RuntimeError: SystemExit: 3"),
    "spoils": ("run.events.t[:] = 0.0", "read-only"),
    "loosens": ("system.stiffness[:] = 0.0", "read-only"),
    "late": ("import late; return Measured(1.0)", "import it at the top of the module"),
}


def test_a_function_that_goes_wrong_costs_its_column_and_not_the_run(text, tmp_path):
    """Nor the columns of the others, of the same run."""
    module = HEAD
    for name, (line, _) in SOME.items():
        lines = f"if system.n == 4:\n    {line}\nreturn Measured(len(run.events))"
        module += (
            one(lines, head="", note='{"least": -2.5}').replace("own:", f"{name}_:").replace("Measured", f"Of_{name}")
        )
        module = module.replace("def one(", f"def {name}(")
    names = [f"mine:{name}" for name in SOME]
    scene = short(text).replace('own = "mine:one"', f"own = {json.dumps([*names, 'mine:well'])}")
    scene = scene.replace("n = [3, 4]", "n = [2, 3, 4]")  # the trial measures the first two
    module += one("return Measured(len(run.events))", "int", head="").replace("def one(", "def well(")
    file = written(tmp_path, scene, module)
    (tmp_path / "late.py").write_text("")
    done = run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    assert "failed" not in done.outcomes
    _, small, large = (row for _, row in query.members(tmp_path / "out").set_index("n").iterrows())
    assert small.own_problem is pd.NA
    assert {small[f"{name}_"] for name in SOME} == {small.n_events}
    assert all(large[f"{name}_"] is pd.NA for name in SOME)
    assert large.own == large.n_events
    reasons = large.own_problem.split("; mine:")
    assert len(reasons) == len(SOME)
    for reason, (name, (_, words)) in zip(reasons, SOME.items(), strict=True):
        assert f"{name}: " in reason
        assert words.replace("own", f"{name}_") in reason
        assert reason.isprintable()


def test_a_run_that_ends_before_t_burn_has_no_value(text, tmp_path):
    scene = load_scene(written(tmp_path, short(text), one("return Measured(window[1])")))
    member = expand(scene)[0]
    assert row(member, scene.recording)["own"] == 12.0
    early = row(replace(member, t_end=1.0), scene.recording)
    assert early["own"] is None
    assert early["own_problem"] == "mine:one: the run ends before t_burn = 2"


def test_what_is_lost_is_known_by_column(text, tmp_path):
    """Of four blocks one value is no share, and the other function fails in words that name the first's columns."""
    mine = one("return Measured(0.5, 0.5 if system.n < 4 else 1.5)", note='{"least": 0, "most": 1}').replace(
        "    own:", '    kept: Annotated[float, "kept"]\n    own:'
    )
    other = one('assert system.n < 4, "mine:one: expected it for kept, or for x"\nreturn Measured(1.0)', head="")
    other = other.replace("def one", "def two").replace("Measured", "Other").replace("own:", "x:")
    scene = short(text).replace('own = "mine:one"', 'own = ["mine:one", "mine:two"]')
    scene = load_scene(written(tmp_path, scene.replace("n = [3, 4]", "n = [2, 3, 4]"), mine + other))
    run_ensemble(scene, tmp_path / "out", workers=0)
    lost = query.members(tmp_path / "out").set_index("n")["own_lost"]
    assert lost.to_dict() == {2: None, 3: None, 4: "own,x"}
    study = study_of(tmp_path / "out")
    problems = {name: {*column.problems} for name, column in study.data.recorded.items()}
    wrong = {row["member_id"] for _, row in study.data.members.iterrows() if row["n"] == 4}
    assert problems == {"kept": set(), "own": wrong, "x": wrong}
    assert study.data.recorded["own"].most == 1.0


def test_a_number_whose_square_float64_does_not_hold_has_no_statistics(text, tmp_path):
    scene = load_scene(written(tmp_path, short(text), one("return Measured(1e300 if system.n == 3 else 1e90)")))
    run_ensemble(scene, tmp_path / "out", workers=0)
    study = study_of(tmp_path / "out")
    numbers = dict(zip(study.data.members["n"], study.number("own"), strict=True))
    assert numbers == {3: pytest.approx(np.nan, nan_ok=True), 4: 1e90}
    assert {*study.data.recorded["own"].problems.values()} == {"beyond 1e+100, of which there are no statistics"}


def test_the_command_says_what_has_no_value(text, tmp_path, monkeypatch, capsys):
    written(tmp_path, short(text), one("return Measured(1 / (4 - system.n))"))
    monkeypatch.chdir(tmp_path)
    computed_here(monkeypatch)
    assert main(["run", "scene.toml", "--no-report"]) == 0
    assert "own     1: mine:one: ZeroDivisionError: division by zero\n" in capsys.readouterr().err


def test_a_dimension_is_scaled_as_that_of_other_columns(text, tmp_path):
    units = '[units]\ntime = "s"\nlength = "mm"\nmass = "g"\nscales = {length = 0.5, time = 0.25, force = 2.0}\n'
    module = one("return Measured(3.0)", "float", note='{"dimension": "speed"}')
    scene = load_scene(written(tmp_path, short(text) + units, module))
    run_ensemble(scene, tmp_path / "out", workers=0)
    (column,) = (column for column in scene.recording.columns if column.name == "own")
    assert scene.unit_names.of(column.dimension) == "mm/s"
    assert set(query.members(tmp_path / "out").own) == {3.0 * 0.5 / 0.25}


@pytest.mark.parametrize(("since", "longest"), [("0", 12.0), ("'t_burn'", 10.0)])
def test_a_time_says_since_when_and_is_no_longer_than_its_run(since, longest, text, tmp_path):
    """Of three blocks no run has it, of four each; what says more than the run has is a problem."""
    mine = one(f"return Measured(None if system.n == 3 else {longest})", "float | None", note=f'{{"since": {since}}}')
    scene = load_scene(written(tmp_path, short(text), mine))
    run_ensemble(scene, tmp_path / "out", workers=0)
    study = study_of(tmp_path / "out")
    assert study.data.recorded["own"].since == 12.0 - longest
    assert study.data.recorded["own"].least == 0.0
    of_three, of_four = sorted(study.groups, key=lambda group: group.key["n"])
    assert study.median(of_three, "own").reason == f"not reached: 100% without it at t = {longest:g}"
    assert study.median(of_four, "own").value == longest
    late = load_scene(written(tmp_path / "late", short(text), mine.replace(f"else {longest}", "else 12.5")))
    problems = [row(member, late.recording)["own_problem"] for member in expand(late)]
    start = 12.0 - longest
    said = f"mine:one: expected at most {longest:g} for own, a time since t = {start:g}, got 12.5; subtract {start:g}"
    assert problems == [None, said]


#: What is wrong with a module, and words of the refusal when its scene is read.
UNREADABLE = {
    "no module": (None, ["the module 'mine' beside the scene", "mine.py"]),
    "no function": (one("").replace("def one", "def once") + "    pass\n",
        ["a function 'one'", "did you mean 'once'"]),
    "syntax": ("def one(:\n", ["SyntaxError"]),
    "import": (one("return 1", head="import nonesuch_at_all\n"), ["ModuleNotFoundError", "nonesuch_at_all"]),
    "no annotation": (one("return 1").replace(" -> Measured", ""), ["to declare that it returns", "got none"]),
    "a number": (one("return 1").replace(" -> Measured", " -> float"), ["to declare that it returns", "got float"]),
    "no note": (one("return 1", note='{"mode": 1}'),
        ["'least', 'most', 'absent', 'since' or 'dimension' for own", "'mode'"]),
    "no dimension": (one("return 1.0", "float", note='{"dimension": "size"}'),
        ["one of time, length, mass,", "as 'dimension' of own, got 'size'"]),
    "a count": (one("return 1", "int", note='{"dimension": "length"}'), ["as 'dimension' of own, got a int"]),
    "most alone": (one("return 1", note='{"most": 1}'),
        ["'most' of own, with 'least' 0", "got another 'least', or none"]),
    "no most": (one("return 1", note='{"least": 0, "most": 0}'), ["a number > 0 as 'most' of own", "got 0"]),
    "no least": (one("return 1", note='{"least": "0"}'), ["a finite number as 'least' of own", "got '0'"]),
    "least text": (one("return 1", "str", note='{"least": 0}'), ["a finite number as 'least' of own", "got a str"]),
    "never absent": (one("return 1", note='{"absent": "none"}'), ["words as 'absent' of own", "`| None`"]),
    "no start": (one("return 1", "float | None", note='{"since": -1}'),
        ["a time >= 0, or \"t_burn\", as 'since' of own", "got -1"]),
    "always there": (one("return 1", note='{"since": 0}'), ["as 'since' of own", "float | None, got another type"]),
    "no words": (one("return 1").replace('Annotated[float, "mine", {}]', "float"),
        ["expected words for own", "'none'"]),
    "a list": (one("return 1", "list[float]"), ["float, int, bool, str for own", "got list"]),
    "two types": (one("return 1", "int | str"), ["float, int, bool, str for own"]),
    "unknown type": (one("return 1", "'Nowhere'"), ["annotations cannot be read", "Nowhere"]),
    "arguments": (one("return 1").replace("(run, system, window)", "(run)"), ["(run, system, window)", "got (run)"]),
    "a column": (one("return 1").replace("own:", "N_Events:"), ["record.own", "'N_Events'", "a column of the data"]),
    "a key": (one("return 1").replace("own:", "Kappa:"), ["record.own", "'Kappa'", "choose another"]),
    "another": (one("return 1").replace("    own:", "    OWN: Annotated[int, 'x']\n    own:"),
        ["another field has it"]),
    "a dimension": (one("return 1").replace("own:", "change:"), ["record.own", "'change'", "a dimension in NetCDF"]),
    "its own": (one("return 1").replace("own:", "own_problem:"), ["record.own", "'own_problem'"]),
}  # fmt: skip


@pytest.mark.parametrize("case", UNREADABLE)
def test_what_is_no_record_is_refused_in_a_line_and_nothing_is_written(case, text, tmp_path, capsys, monkeypatch):
    module, words = UNREADABLE[case]
    file = written(tmp_path, short(text), module or "")
    if module is None:
        (tmp_path / "mine.py").unlink()
    monkeypatch.chdir(tmp_path)
    assert main(["run", str(file), "--out", "out"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "record.own" in line
    assert all(word in line for word in words), line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("own", "words"), [
    ('"mine"', "expected module:function"),
    ('["mine:one", "mine:one"]', "each value once"),
    ("3", "record.own"),
    ('"mine:one"\nfunctions = {}', "expected what `load_scene` and the command write here for mine:one"),
    ('"mine:one"\ndt = 0.5', "dt: expected only with some of"),
    ('"mine:needs"', "dt: expected with `own = 'mine:needs'`"),
])  # fmt: skip
def test_a_key_that_is_wrong_is_refused(own, words, text, tmp_path):
    mine = one("return Measured(1.0)") + "\n\ndef needs(run, system, window, samples) -> Measured:\n    return 1\n"
    with pytest.raises(SceneError) as refusal:
        load_scene(written(tmp_path, short(text).replace('own = "mine:one"', f"own = {own}"), mine))
    assert words in str(refusal.value)


def test_a_parameter_and_a_column_have_one_name_space(text, tmp_path):
    own = "from stickslip import System\ndef draw(n, rng, OWN):\n    return System([[0.5]], 0.1)\n"
    scene = short(text).replace('"antisymmetric"', '"mine:draw"\nparameters = {OWN = 0.5}')
    scene = scene.replace("friction = 0.5\n", "").replace("n = [3, 4]", "n = 1")
    with pytest.raises(SceneError, match=r"record\.own: .* got 'own': a parameter of the function has it"):
        load_scene(written(tmp_path, scene, f"{own}\n{one('return Measured(1.0)')}"))
    scene = scene.replace("OWN = 0.5", "mine = 0.5")
    both = f"{own.replace('OWN', 'mine')}\n{one('return Measured(window[0])')}"
    run_ensemble(load_scene(written(tmp_path, scene, both)), tmp_path / "out", workers=0)
    assert set(query.members(tmp_path / "out").own) == {2.0}


#: What the trial refuses, and words of the refusal.
TRIED = {
    "raises": ("raise KeyError('a\\nb')", ["KeyError", "mine:one", "n3-m000"]),
    "random": ("return Measured(float(np.random.default_rng().random()))", ["got values that differ"]),
    "keeps the most": (
        "one.k = max(getattr(one, 'k', 0), system.n)\nreturn Measured(one.k)",
        ["got values that differ", "keep nothing from call to call"],
    ),
    "imports late": ("import late; return Measured(1.0)", ["late.py", "import it at the top of the module"]),
    "reads late": ("return Measured(len(open(__file__[:-7] + 'data.txt').read()))", ["data.txt", "at the top"]),
}


@pytest.mark.parametrize("case", TRIED)
def test_a_function_that_misbehaves_on_the_first_run_is_refused_before_anything_is_written(
    case, text, tmp_path, capsys
):
    line, words = TRIED[case]
    file = written(tmp_path, short(text), one(line))
    (tmp_path / "late.py").write_text("")
    (tmp_path / "data.txt").write_text("")
    scene = load_scene(file)
    with pytest.raises(SceneError) as refusal:
        run_ensemble(scene, tmp_path / "out", workers=0)
    assert all(word in str(refusal.value) for word in ["record.own", *words]), str(refusal.value)
    assert str(refusal.value).isprintable()
    assert not (tmp_path / "out").exists()
    if case == "raises":
        assert main(["run", str(file), "--dry-run", "--out", str(tmp_path / "out")]) == 2
        assert "KeyError" in capsys.readouterr().err


def test_a_number_that_is_not_finite_may_be_of_the_first_run(text, tmp_path):
    file = written(tmp_path, short(text), one("return Measured(np.nan if system.n == 3 else 1.0)"))
    run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    assert query.members(tmp_path / "out").groupby("n").own.count().tolist() == [0, 1]


# ---------------------------------------------------------------------------------------------- changes


@pytest.mark.parametrize(("name", "old", "new"), [("mine.py", "len(left) > 0", "True"), ("beside.py", "0", "1")])
def test_a_module_that_changed_is_refused(name, old, new, text, tmp_path, content):
    """The one that is named, and one that it imports: of the same size or not."""
    file = written(tmp_path, text)
    run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    before = content(tmp_path / "out")
    scene, changed = load_scene(file), (tmp_path / name).read_text().replace(old, new)
    (tmp_path / name).write_text(changed)
    file.write_text(text.replace("matrices = 3", "matrices = 4"))
    words = "sha256" if name == "mine.py" else r"beside\.beside\.py"
    with pytest.raises(StoreError, match=rf"record\.functions\.mine:counted\..*{words}"):
        run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    assert content(tmp_path / "out") == before
    assert any(
        "record.own" in problem and name in problem.replace("'mine'", "mine.py")
        for problem in verify(tmp_path / "out")
    )
    function._module.cache_clear()
    with pytest.raises(SceneError, match=r"record\.own: expected .* as it was"):  # as it changes while it runs
        run_ensemble(scene, tmp_path / "another", workers=0)
    found = run_member(scene, expand(scene)[0].member_id)  # it can be run again, once the module is restored
    assert found["outcome"] == "failed"
    assert "as it was" in found["reason"]


def test_a_scene_is_code_and_its_dataset_is_not(text, tmp_path, monkeypatch, capsys):
    """Whatever `run` does loads the module; reading what came of it does not, even beside the module."""
    file, mark = written(tmp_path, text, f"{MINE}\nopen(__file__ + '.run', 'a').close()\n"), tmp_path / "mine.py.run"
    member = expand(load_scene(file))[0].member_id
    monkeypatch.chdir(tmp_path)
    computed_here(monkeypatch)
    for more in (["--dry-run"], ["--only", member], ["--no-report"]):
        mark.unlink()
        function._module.cache_clear()
        assert main(["run", "scene.toml", *more]) == 0
        assert mark.exists(), more
    mark.unlink()
    function._module.cache_clear()
    (tmp_path / "mine.py").rename(tmp_path / "runs" / "scene" / "mine.py")  # as a stranger's dataset may hold it
    (tmp_path / "beside.py").rename(tmp_path / "runs" / "scene" / "beside.py")
    monkeypatch.chdir(tmp_path / "runs" / "scene")
    for read in (
        ["status", "."],
        ["verify", "."],
        ["report", "."],
        ["report", ".", "--compare", "."],
        ["query", ".", "SELECT max(Share) AS m FROM members"],
        ["export", ".", "--netcdf", str(tmp_path / "out.nc")],
    ):
        assert main(read) in (0, 1), read
    assert "Share" in capsys.readouterr().out
    assert not list(tmp_path.rglob("*.run"))


def test_truths_and_texts_are_in_netcdf(text, tmp_path):
    netcdf = pytest.importorskip("netCDF4")
    run_ensemble(load_scene(written(tmp_path, text)), tmp_path / "out", workers=0)
    assert main(["export", str(tmp_path / "out"), "--netcdf", str(tmp_path / "out.nc")]) == 0
    table = query.members(tmp_path / "out")
    with netcdf.Dataset(tmp_path / "out.nc") as held:
        assert held["leaves"][:].tolist() == [int(one) for one in table.leaves]
        assert held["busiest"][:].tolist() == table.busiest.fillna("").tolist()
        assert held["Share"].long_name == "share of blocks that leave from t_burn on"


def test_a_package_is_found_without_loading_it(tmp_path, monkeypatch):
    """`verify` looks for the module of a stranger's scene; a package's `__init__` is code."""
    package = tmp_path / "site" / "strange"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise SystemExit('loaded')\n")
    (package / "inner.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path / "site")
    assert file_of("strange.inner", tmp_path) == package / "inner.py"
    assert file_of("strange.inner.deeper", tmp_path) is None
    assert file_of("strange.nowhere", tmp_path) is None
    assert file_of("nowhere.inner", tmp_path) is None


def test_it_is_added_to_a_dataset_that_is_finished(text, tmp_path, content, monkeypatch, capsys):
    """With the bytes of a run that had it from the start; another record is added without calling it again."""
    file = written(tmp_path, text)
    run_ensemble(load_scene(file), tmp_path / "whole", workers=0)
    plain = text.replace('t_burn = 2.0\nown = ["mine:counted", "mine:fastest"]\ndt = 0.5\n', "")
    (tmp_path / "plain.toml").write_text(plain)
    run_ensemble(load_scene(tmp_path / "plain.toml"), tmp_path / "runs" / "out", workers=0)
    monkeypatch.chdir(tmp_path)
    names, out = ["mine:counted", "mine:fastest"], tmp_path / "runs" / "more"
    words = ["--record", *names, "t_burn=2.0", "dt=0.5", "--out", "runs/more", "--dry-run"]
    assert main(["extend", "runs/out", *words]) == 0
    assert "to run  " in capsys.readouterr().out
    extend(tmp_path / "runs" / "out", {"own": names, "t_burn": 2.0, "dt": 0.5}, out, workers=0)
    assert content(out / "data") == content(tmp_path / "whole" / "data")
    run_ensemble(load_scene(file), out, workers=0)  # it is the scene's
    function._module.cache_clear()
    (tmp_path / "mine.py").unlink()
    extend(out, {"waiting": True}, tmp_path / "last", workers=0)
    assert {*query.members(out).columns} < {*query.members(tmp_path / "last").columns}
    assert query.members(tmp_path / "last").own_problem.isna().all()
    with pytest.raises(SceneError, match=r"record\.own: "):  # of members that run again it measures too
        extend(out, {"amplitude": True}, tmp_path / "none", workers=0)


@pytest.mark.parametrize("line", ["raise KeyError(1)", "return Measured(np.random.default_rng().random())"])
def test_one_that_goes_wrong_is_not_added(line, text, tmp_path):
    mine = one(line)
    file = written(tmp_path, short(text).replace('own = "mine:one"', ""), mine)
    file.write_text(file.read_text().replace("t_burn = 2.0\n", "", 1))
    run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    with pytest.raises(SceneError, match=r"record\.own: mine:one"):
        extend(tmp_path / "out", {"own": "mine:one"}, tmp_path / "more", workers=0)
    with pytest.raises(SceneError, match=r"record\.own: expected the module 'none'"):
        extend(tmp_path / "out", {"own": ["none:one"]}, tmp_path / "more", workers=0)
    assert not (tmp_path / "more").exists()
