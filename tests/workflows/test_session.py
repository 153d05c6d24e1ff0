"""What a session has set does not reach what is computed, drawn or written."""

import warnings
from hashlib import sha256
from io import BytesIO

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from stickslip import draw_system, run_scene, simulate
from stickslip.analysis.style import FORMS, blank, styled
from stickslip.pipeline import load_scene
from stickslip.workflows import reporting

SYSTEM = draw_system("antisymmetric", n=20, seed=1)


def drawing():
    """A style of one's own."""
    plt.style.use("dark_background")
    matplotlib.rc("text", usetex=True)
    matplotlib.rcParams.update({"path.sketch": (1, 100, 2), "savefig.bbox": "tight"})
    matplotlib.rcParams.update({"font.size": 30, "figure.dpi": 200, "svg.fonttype": "none"})


def computing():
    """Strict arithmetic and warnings, other nulls and texts."""
    np.seterr(all="raise")
    np.set_printoptions(legacy="1.13", precision=2)
    pd.set_option("future.distinguish_nan_and_na", True)
    pd.set_option("mode.string_storage", "python")
    warnings.simplefilter("error")


OPTIONS = ("future.distinguish_nan_and_na", "mode.string_storage")


@pytest.fixture(params=[drawing, computing])
def session(request):
    """A function that sets what a user's session may have set, which is undone after the test."""
    options = [part for name in OPTIONS for part in (name, pd.get_option(name))]
    numpy = np.errstate(), np.printoptions()
    with matplotlib.rc_context(), pd.option_context(*options), numpy[0], numpy[1], warnings.catch_warnings():
        yield request.param


def digest(content):
    return sha256(content).hexdigest()


def report(dataset, out):
    """The files of a report, with its figures."""
    reporting.write(reporting.report(dataset), out)
    return {str(file.relative_to(out)): digest(file.read_bytes()) for file in out.rglob("*") if file.is_file()}


def pictures():
    """What a notebook shows of a run, and the files of a figure."""
    run = simulate(SYSTEM, -0.7, -0.4, t_end=20.0, t_eval=np.linspace(0.0, 20.0, 41), stop_early="always")
    ax = run.plot("phase")
    stream = BytesIO()
    with matplotlib.style.context("default"):  # saving is the user's
        ax.figure.savefig(stream, format="png")
    plt.close(ax.figure)
    with styled():
        figure = blank(2.0)
        run.plot("n_stick", figure.subplots())
    files = {ending: digest(contents(figure)) for ending, contents in FORMS.items()}
    return files | {"html": digest(run._repr_html_().encode()), "phase": digest(stream.getvalue())}


@pytest.fixture(scope="module")
def expected(dataset, tmp_path_factory):
    return report(dataset, tmp_path_factory.mktemp("plain")) | pictures()


def test_all_has_the_same_bytes(session, expected, dataset, tmp_path):
    session()
    before = dict(matplotlib.rcParams), np.geterr(), np.get_printoptions()
    assert report(dataset, tmp_path) | pictures() == expected
    assert (dict(matplotlib.rcParams), np.geterr(), np.get_printoptions()) == before


def test_data_have_the_same_bytes(session, small_scene, dataset, tmp_path):
    session()
    run_scene(load_scene(small_scene), tmp_path / "small", workers=0, quiet=True)
    for shard in (dataset / "data").iterdir():
        assert (tmp_path / "small" / "data" / shard.name).read_bytes() == shard.read_bytes()


def test_axes_that_are_given_keep_their_style():
    """A dark style is the user's own where the axes are."""
    run = simulate(SYSTEM, -0.7, -0.4, t_end=5.0)
    with plt.style.context("dark_background"):
        ax = run.plot(ax=matplotlib.figure.Figure().subplots())
        assert ax.xaxis.label.get_color() == "white"
