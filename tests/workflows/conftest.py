import html
import re

import pytest

from stickslip.analysis.page.parts import Drawn
from stickslip.pipeline import SceneError
from stickslip.workflows.commands import main
from stickslip.workflows.gallery import load_chart
from stickslip.workflows.gallery.charts import runner
from stickslip.workflows.scenes import chart_of, shipped
from tests.processes import computed_here
from tests.scenes import ensemble

SMALL = ensemble(
    12,
    40.0,
    3,
    seed=1,
    title="A small <scene>",
    rest="[record]\nevents = true",
    analysis="t_burn = 1.0\ndt = [0.5]\nresamples = 50",
)


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory):
    file = tmp_path_factory.mktemp("scene") / "small.toml"
    file.write_text(SMALL)
    return file


@pytest.fixture(scope="session")
def dataset(small_scene, tmp_path_factory):
    """A finished small run with its report, made by the command itself."""
    out = tmp_path_factory.mktemp("runs") / "small"
    assert main(["run", str(small_scene), "--out", str(out), "--workers", "1"]) == 0
    return out


@pytest.fixture(params=sorted(name for name, file in shipped().items() if chart_of(file) is None))
def shipped_scene(request):
    return request.param


@pytest.fixture
def refuse(tmp_path, capsys):
    """Change a scene that is good, run it, and see it refused: key and remedy named, nothing written."""

    def check(source, old, new, key, remedy):
        assert source.count(old) == 1
        file, out = tmp_path / "bad.toml", tmp_path / "out"
        file.write_text(source.replace(old, new))
        assert main(["run", str(file), "--out", str(out)]) == 2
        error = capsys.readouterr().err
        assert f"bad.toml: {key}" in error
        assert remedy in error
        assert not out.exists()
        with pytest.raises(SceneError):
            load_chart(file)

    return check


@pytest.fixture
def here(monkeypatch):
    computed_here(monkeypatch)


@pytest.fixture
def undrawn(monkeypatch):
    """Pages of charts without their figures, which take most of their time."""
    monkeypatch.setattr(runner, "draw", lambda *_, **__: Drawn(""))


@pytest.fixture(scope="session")
def said():
    """What the folded part of a chart's page says in numbers: a line each, behind its heading."""

    def lines(report):
        numbers = report.html.partition('<details id="numbers">')[2].partition("</details>")[0]
        found, heading = [], ""
        for tag, content in re.findall(r"<(h3|li)>(.*?)</\1>", numbers, flags=re.DOTALL):
            text = " ".join(html.unescape(re.sub(r"<[^>]*>", "", content)).split())
            if tag == "h3":
                heading = text
            elif text:
                found.append(f"{heading}: {text}")
        return found

    return lines
