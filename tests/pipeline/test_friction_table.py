"""A table of friction beside a scene."""

import pytest

from stickslip import Table
from stickslip.pipeline import SceneError, load_scene, parse_scene, query, run_ensemble
from stickslip.pipeline.ensemble.expand import expand
from tests.scenes import COULOMB, ensemble

ROWS = ((0.0, 0.6), (0.05, 0.45), (0.2, 0.4), (1.0, 0.42), (3.0, 0.5))
LAW = Table(*zip(*ROWS, strict=True))
INLINE = "{speeds = [0.0, 0.05, 0.2, 1.0, 3.0], coefficients = [0.6, 0.45, 0.4, 0.42, 0.5]}"


def text(law, more="static = 0.7"):
    return ensemble(3, 2.0, 2, COULOMB).replace("n = 3", f"n = 3\n{more}\nweakening = {law}")


@pytest.mark.parametrize("file", [
    "speed, coefficient\n" + "".join(f"{x}, {y}\n" for x, y in ROWS),
    "# measured\n\n" + "".join(f"{x}\t{y}\n" for x, y in ROWS),
    "\ufeff" + "".join(f"{x};{y}\r\n" for x, y in ROWS),
])  # fmt: skip
def test_a_file_is_read_once_and_its_numbers_are_the_scene(file, tmp_path):
    (tmp_path / "friction.csv").write_text(file)
    (tmp_path / "a.toml").write_text(text('{table = "friction.csv"}'))
    (tmp_path / "b.toml").write_text(text(INLINE))
    scene, inline = load_scene(tmp_path / "a.toml"), load_scene(tmp_path / "b.toml")
    assert scene.hash == inline.hash
    (tmp_path / "friction.csv").unlink()
    run_ensemble(scene, tmp_path / "out", workers=0)
    assert query.members(tmp_path / "out").outcome.isin(["finished", "collapsed"]).all()
    for member in expand(parse_scene(text(INLINE))):
        assert member.system().weakening == LAW


def test_changed_numbers_are_another_scene():
    assert parse_scene(text(INLINE)).hash != parse_scene(text(INLINE.replace("0.42", "0.43"))).hash


@pytest.mark.parametrize(("law", "more", "words"), [
    ('{law = "stribek", speed = 0.1}', "static = 0.7", "did you mean 'stribeck'"),
    ('{law = "rational"}', "", r'rate: expected that of law = "rational", found nothing'),
    ("{}", "", r"law: expected a law or a table, got neither"),
    ('{table = "friction.csv"}', "", r"expected a law or a table, got no speeds and coefficients beside `table`"),
    ("{speeds = [0.0, 1.0, 2.0, 3.0]}", "", r"got no speeds and coefficients beside `speeds`"),
    (INLINE.replace("{", '{law = "rational", rate = 1.0, '), "", r"expected either a law or a table, got `law` and"),
    (INLINE.replace("{", "{rate = 1.0, "), "", r"rate: expected none beside a table"),
    (INLINE.replace("0.05", "0.3"), "", r"speeds: expected numbers that rise from 0, got 0\.2 after 0\.3 in place 2"),
    (INLINE.replace("0.45", "-0.45"), "", r"coefficients: expected at least 0, got -0\.45"),
    (INLINE, "static = 0.5", r"system\.static: expected at least the kinetic friction"),
])  # fmt: skip
def test_what_is_no_law_is_refused(law, more, words):
    with pytest.raises(SceneError, match=words):
        parse_scene(text(law, more))


@pytest.mark.parametrize(("file", "words"), [
    ("0 0.5\n1 x\n", r"friction\.csv: .*line 2, column 2: expected a finite number, got 'x'"),
    ("0 0.5 1\n", r"expected two columns, got 3"),
    ("", r"it is empty"),
])  # fmt: skip
def test_what_is_no_file_of_a_table_is_refused(file, words, tmp_path):
    (tmp_path / "friction.csv").write_text(file)
    (tmp_path / "a.toml").write_text(text('{table = "friction.csv"}'))
    with pytest.raises(SceneError, match=words):
        load_scene(tmp_path / "a.toml")
    (tmp_path / "friction.csv").unlink()
    with pytest.raises(SceneError, match=r"system\.weakening\.table: .* cannot be read"):
        load_scene(tmp_path / "a.toml")
