"""What the tests of the charts share."""

import pytest

from stickslip.pipeline import SceneError
from stickslip.workflows.charts import load_chart
from stickslip.workflows.cli import main


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
