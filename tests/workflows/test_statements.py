"""The tool that compares what reports say tells a change of a statement or a number, and nothing else."""

from tests.statements.__main__ import STATEMENTS, differences, sentences

PAGE = """<html><head><style>p {margin: 0}</style></head><body>
<h1>Blocks</h1><ul><li>At t = 1.50 all stick. None <b>slips</b>.</li></ul>
<table><tr><td>n</td><td>20</td></tr></table><p>stickslip: 1.0; scene: ab12.</p></body></html>"""


def test_a_page_is_its_sentences_and_rows():
    assert sentences(PAGE) == ["Blocks", "At t = 1.50 all stick.", "None slips.", "n | 20"]


def test_numbers_differ_by_value(tmp_path):
    for name, (statement, table) in {
        "old": ("Half by t = 1.50.\nAll stick.\n", "key,mean\na,0.10\nb,0.2\n"),
        "new": ("Half by t = 1.5.\nNone sticks.\n", "key,mean\na,0.1\nb,0.3\n"),
    }.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / STATEMENTS).write_text(statement)
        (tmp_path / name / "means.csv").write_text(table)
    (tmp_path / "new" / "more.csv").write_text("n\n1\n")
    assert differences(tmp_path / "old", tmp_path / "old") == []
    assert differences(tmp_path / "old", tmp_path / "new") == [
        "- means.csv: b,0.2",
        "+ means.csv: b,0.3",
        "+ more.csv: n",
        "+ more.csv: 1",
        f"- {STATEMENTS}: All stick.",
        f"+ {STATEMENTS}: None sticks.",
    ]
