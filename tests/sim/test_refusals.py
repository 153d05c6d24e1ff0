"""What is refused: an error whose message names the argument, says what was expected, and what came."""

import warnings

import numpy as np
import pytest
import scipy.sparse

from stickslip.sim import Harmonic, Piecewise, Rational, Stribeck, System, draw_system, perturb_system, simulate
from stickslip.sim.episodes import episodes
from stickslip.workflows.gallery.theory import blowup, folds, slow_time
from stickslip.workflows.gallery.theory.laws import Coulomb, Modified, StaticAboveKinetic

ONE, TWO = System([[1.0]], 0.1), System(np.eye(2), 0.1)
DRAWN = draw_system("antisymmetric", 4, 0)
PAIR = folds.two_blocks(kappa1=1.1, kappa2=1.6, kappa12=0.5, rho=0.1, mu=1.0, v=-1.0)
MASKED = np.ma.masked_array([1.0, 2.0], [False, True])
MASKED_MATRIX = np.ma.masked_array(np.eye(2), np.eye(2))


class Chirp(Harmonic):
    def at(self, times):
        return np.cos(np.square(times))


class Smooth(Piecewise):
    pass


def system(stiffness=((1.0, 0.0), (0.0, 1.0)), damping=0.1, *more, **terms):
    return lambda: System(stiffness, damping, *more, **terms)


def three(**terms):
    return lambda: System(np.eye(3), **{"damping": 0.1} | terms)


def run(of=ONE, z0=0.0, w0=0.0, t_end=1.0, **settings):
    return lambda: simulate(of, z0, w0, t_end, **settings)


def smooth(of=ONE, **settings):
    return run(of, engine="sigmoid", **settings)


def beyond(index, form):
    """A sparse matrix with an index out of range."""
    matrix = scipy.sparse.coo_array(np.diag([1.0, 2.0, 3.0, 4.0]) + np.eye(4, k=-3)).asformat(form)
    if form == "coo":
        matrix.coords[0][1] = index
    else:
        matrix.indices[1] = index
    return matrix


VALUE, TYPE, EITHER = ValueError, TypeError, (TypeError, ValueError)
GOT = "expected .* got "
#: Argument, error, a regular expression of what follows in the message, the call.
ARRAYS = [
    ("stiffness", EITHER, GOT, system([1.0])),
    ("stiffness", EITHER, GOT, system(np.ones((2, 3)))),
    ("stiffness", EITHER, GOT, system([[np.nan]])),
    ("stiffness", EITHER, GOT, system(scipy.sparse.csc_array([[np.inf]]))),
    ("stiffness", EITHER, GOT, system(np.empty((0, 0)))),
    ("stiffness", EITHER, GOT, system("soft")),
    ("stiffness", EITHER, GOT, system([[1.0, 2.0], [1.0]])),
    ("stiffness", EITHER, GOT, system(np.array([[1j]]))),
    *(
        ("stiffness", VALUE, "expected a sparse matrix with its indices in range, got", system(beyond(index, form)))
        for index in (-5, 9)
        for form in ("csr", "csc", "bsr", "coo")
    ),
    ("damping", EITHER, GOT, system([[1.0]], [0.1, 0.2])),
    ("damping", EITHER, GOT, system([[1.0]], np.inf)),
    ("damping", EITHER, GOT, system([[1.0]], "x")),
    ("damping", EITHER, GOT, system([[1.0]], np.array([1j]))),
    ("damping", VALUE, r"expected a matrix of shape \(3, 3\), got shape \(2, 3\)", three(damping=np.ones((2, 3)))),
    ("damping", VALUE, "expected finite entries", three(damping=np.full((3, 3), np.nan))),
    ("damping", VALUE, "expected a number or an array", three(damping=np.ones((3, 3, 3)))),
    ("damping", TYPE, "expected real entries", three(damping=1j * scipy.sparse.eye_array(3))),
    ("damping", VALUE, r"expected a matrix of shape \(3, 3\), got shape", three(damping=scipy.sparse.eye_array(2))),
    ("damping", VALUE, "expected finite entries", three(damping=np.nan * scipy.sparse.eye_array(3))),
    ("damping", TYPE, "expected a number", three(damping=[[1.0], [1.0, 2.0]])),
    ("friction", EITHER, GOT, system([[1.0]], 0.1, -1.0)),
    ("friction", EITHER, GOT, system([[1.0]], 0.1, [np.nan])),
    ("friction", EITHER, GOT, system([[1.0]], 0.1, True)),
    ("belt_speed", EITHER, GOT, system([[1.0]], 0.1, 1.0, [0.1, 0.2])),
    ("belt_speed", EITHER, GOT, system([[1.0]], 0.1, 1.0, None)),
    ("belt_speed", VALUE, "expected a number or an array of shape", system(belt_speed=[1.0, 2.0, 3.0])),
    ("belt_speed", TYPE, "expected a number, 2 numbers or a Piecewise", system(belt_speed=Harmonic(1.0, 1.0))),
    ("belt_speed", VALUE, "expected finite values", system(belt_speed=np.nan)),
    ("static", VALUE, "expected at least the kinetic friction, got 0.9 below 1 at block 0", three(static=0.9)),
    ("static", VALUE, ".* got 0.5 below 1 at block 2; raise it", three(static=[2.0, 2.0, 0.5])),
    ("static", VALUE, r"expected a number or an array of shape \(3,\)", three(static=[2.0, 2.0])),
    ("static", VALUE, "expected finite values", three(static=np.inf)),
    ("static", TYPE, "expected a number or 3 numbers", three(static="high")),
    ("mass", VALUE, "expected m > 0, got 0 for block 0", system(mass=0.0)),
    ("mass", VALUE, "expected m > 0, got -1 for block 1", system(mass=[1.0, -1.0])),
    ("mass", VALUE, "expected finite values", system(mass=np.inf)),
    ("z0", EITHER, GOT, run(z0=[0.0, 0.0])),
    ("z0", EITHER, GOT, run(z0=True)),
    ("w0", EITHER, GOT, run(w0=np.nan)),
    *(
        (name, TYPE, ".*masked array", system(**{name: given}))
        for name, given in (
            ("stiffness", MASKED_MATRIX), ("stiffness", [MASKED, MASKED]), ("damping", MASKED),
            ("damping", MASKED_MATRIX), ("friction", MASKED), ("belt_speed", MASKED), ("static", MASKED),
            ("mass", MASKED), ("force", MASKED), ("force", [MASKED, Harmonic(1.0, 1.0)]),
        )
    ),
    ("amplitude", TYPE, ".*masked array", lambda: Harmonic(MASKED, 1.0)),
    ("times", TYPE, ".*masked array", lambda: Piecewise(MASKED, [1.0, 2.0])),
    ("values", TYPE, ".*masked array", lambda: Piecewise([1.0, 2.0], MASKED)),
    *(
        (name, TYPE, ".*masked array", run(TWO, **{"t_end": 3.0} | {name: given}))
        for name, given in (
            ("z0", MASKED), ("w0", MASKED), ("t_eval", MASKED), ("modes", MASKED), ("t_end", np.ma.masked)
        )
    ),
]  # fmt: skip
TERMS = [
    ("force", VALUE, r"expected a number or an array of shape \(2,\)", system(force=[1.0, 2.0, 3.0])),
    ("force", TYPE, "expected a number or 2 numbers", system(force="strong")),
    ("force", VALUE, r"amplitude: .* got shape \(3,\)", system(force=Harmonic([1.0] * 3, 1.0))),
    ("force", VALUE, r"values: expected shape \(k,\) or", system(force=Piecewise([0.0, 1.0], [[1.0] * 3] * 2))),
    ("amplitude", VALUE, "expected finite numbers, got inf", lambda: Harmonic(np.inf, 1.0)),
    ("amplitude", VALUE, r"expected a number, or one a block, got shape \(1, 1\)", lambda: Harmonic([[1.0]], 1.0)),
    ("times", VALUE, "expected at least one, and each after the one", lambda: Piecewise([0.0, 0.0], [1.0, 2.0])),
    ("times", VALUE, "expected at least one", lambda: Piecewise([], [])),
    ("times", VALUE, "expected as much time .* after 1;", lambda: Piecewise([0, 1, 1 + 5e-16], [1, 1e300, -1e300])),
    ("values", VALUE, r"expected shape \(2,\) or \(2, n\)", lambda: Piecewise([0.0, 1.0], [1.0])),
    *(
        (name, TYPE, "expected Harmonic or Piecewise itself, got its subclass", system([[1.0]], **{name: given}))
        for name, given in (
            ("force", Chirp(1.0, 1.0)), ("force", Smooth([0, 1], [0, 1])), ("belt_speed", Smooth([0, 1], [1, 2]))
        )
    ),
    ("weakening", TYPE, r"expected Rational\(rate\) or Stribeck\(speed\).*, got 3.0", system(weakening=3.0)),
    ("static", VALUE, "expected with the law of Stribeck, .* found nothing", system(weakening=Stribeck(1.0))),
    *(
        (name, VALUE, r"expected a number in \(0, inf\)", lambda law=law, number=number: law(number))
        for law, name in ((Rational, "rate"), (Stribeck, "speed"))
        for number in (0.0, -1.0, np.inf)
    ),
    ("back_slip", TYPE, "expected True or False, got 0", system(back_slip=0)),
    ("back_slip", VALUE, "expected True .* that of block 0", system(back_slip=False, belt_speed=0.0)),
    ("back_slip", VALUE, ".* that of block 1", system(back_slip=False, belt_speed=[0.1, 0.0])),
    (
        "back_slip", VALUE, "expected True for a belt that rests or turns",
        system(back_slip=False, belt_speed=Piecewise([0.0, 1.0], [0.1, -0.1])),
    ),
    ("seed", EITHER, "expected an integer.*, got ", lambda: draw_system("full", 3, -1)),
    *(
        ("seed", EITHER, "expected an integer.*, got ", call)
        for seed in (None, 1.5, "1", [1, 2])
        for call in (
            lambda seed=seed: draw_system("full", 3, seed),
            lambda seed=seed: perturb_system(DRAWN, "antisymmetric", 0.1, seed),
        )
    ),
    (
        "reading", VALUE, "expected one of scale, relative, damping matrix, got 'absolute'",
        lambda: perturb_system(DRAWN, "antisymmetric", 0.1, 0, reading="absolute"),
    ),
    (
        "size", VALUE, "expected less than 1 for reading='relative', got 1",
        lambda: perturb_system(DRAWN, "antisymmetric", 1.0, 0, reading="relative"),
    ),
    ("size", VALUE, "expected a number >= 0, got -1", lambda: perturb_system(DRAWN, "antisymmetric", -1, 0)),
    *(
        (
            "reading", VALUE, "expected relative, which keeps what `springs` is, got",
            lambda reading=reading: perturb_system(draw_system("springs", 4, 0), "springs", 0.1, 0, reading=reading),
        )
        for reading in ("scale", "damping matrix")
    ),
    (
        "system", VALUE, "expected a diagonal damping, as drawn",
        lambda: perturb_system(DRAWN.changed(damping=np.eye(4) + np.eye(4, k=1)), "antisymmetric", 0.1, 0),
    ),
]  # fmt: skip
RUNS = [
    ("system", EITHER, GOT, run(np.eye(1))),
    ("t_end", EITHER, GOT, run(t_end=-1.0)),
    ("t_end", EITHER, GOT, run(t_end=np.inf)),
    ("t_end", EITHER, GOT, run(t_end=None)),
    ("t_start", EITHER, GOT, run(t_start=np.nan)),
    ("engine", EITHER, GOT, run(engine="stokes")),
    *(("tol", EITHER, GOT, run(tol=tol)) for tol in (0.0, np.nan, 0.1, "fine")),
    *(("eps", EITHER, GOT, smooth(eps=eps)) for eps in (0.0, "thin")),
    ("eps", VALUE, ", ratio: stick='manifold' needs ratio .* got 2;", smooth(eps=2.0)),
    ("rtol", EITHER, GOT, smooth(rtol=-1e-6)),
    ("atol", EITHER, GOT, smooth(atol=np.nan)),
    ("ratio", EITHER, GOT, smooth(ratio=0.0)),
    ("ratio", EITHER, GOT, smooth(ratio=[1.0, 1.0])),
    ("stick", EITHER, GOT, smooth(stick="glue")),
    ("threshold", EITHER, GOT, smooth(threshold=0.0)),
    ("stop_early", EITHER, GOT, run(stop_early="no")),
    ("times", EITHER, GOT, lambda: simulate(ONE, 0.0, 0.0, 1.0).n_stick([0.5, np.nan])),
    ("time", EITHER, GOT, lambda: simulate(ONE, 0.0, 0.0, 1.0).events.mode_at([0.1, 0.2])),
    ("tol", TYPE, r'unknown to the engine "sigmoid".* rtol, atol, .*did you mean .rtol.\?$', smooth(tol=1e-6)),
    ("eps", TYPE, 'unknown to the engine "coulomb", which takes tol, stop_early; .*"sigmoid"$', run(eps=0.1)),
    ("samples", TYPE, ".*; leave it out$", run(tol=1e-6, samples=10)),
    ("z0s", TYPE, ".*; leave it out$", run(z0s=1.0)),
    ("teval", TYPE, r".*; did you mean 't_eval'\?$", smooth(teval=[1.0])),
    *(
        ("t_eval", VALUE, r"expected times in \[0, 60\] in rising order", run(t_end=60, t_eval=times, engine=engine))
        for times in ([-1.0], [61.0], [2.0, 1.0], [[1.0]], [np.nan], 3.0)
        for engine in ("coulomb", "sigmoid")
    ),
    *(
        ("thresholds", VALUE, "expected different finite numbers > 0", smooth(thresholds=thresholds))
        for thresholds in ([0.0], [1.0, 1.0], [-1.0], [np.inf], 1.0)
    ),
    *(
        ("modes", VALUE, "expected 2 of the numbers", run(TWO, modes=modes))
        for modes in ([0], [0, 2], 0, [0.5, 0], [[0, 0]])
    ),
    ("modes", VALUE, "expected None with engine='sigmoid'", smooth(TWO, modes=[0, 0])),
    ("static", VALUE, "engine='sigmoid' .* got 1 above 0 at block 1", smooth(TWO.changed(friction=[1, 0], static=1))),
    (
        "back_slip", VALUE, "engine='sigmoid' .* got none at block 1",
        smooth(System(np.eye(2), 0.1, [1.0, 0.0], back_slip=False), w0=-0.2),
    ),
    *(
        (name, VALUE, "expected .*, all that engine='moreau' takes", run(TWO.changed(**{name: x}), engine="moreau"))
        for name, x in (("force", 1.0), ("belt_speed", [-0.1, -0.2]))
    ),
    ("step", VALUE, "expected", run(System([[1.0]], 0.0), engine="moreau", step=0.0)),
    ("damping", VALUE, "expected a diagonal", run(TWO.changed(damping=[[1.0, 0.5], [0.0, 1.0]]), engine="moreau")),
    ("belt_speed", VALUE, r"expected a number or an array of shape \(4,\)", lambda: episodes(of_four(), [1, 2])),
    ("belt_speed", TYPE, "expected a number, 4 numbers or a Piece", lambda: episodes(of_four(), Harmonic(1.0, 1.0))),
    ("belt_speed", TYPE, "expected a number or 4 numbers", lambda: episodes(of_four(), "slow")),
]  # fmt: skip
THEORY = [
    *(
        (name, EITHER, GOT, call)
        for name, call in (
            ("s", lambda: folds.two_blocks(1.1, 1.6, 0.5, 0.1, 1.0, -1.0, s=0)),
            ("kappa12", lambda: folds.two_blocks(1.1, 1.6, np.nan, 0.1, 1.0, -1.0)),
            ("z", lambda: folds.sticking_lambda(PAIR, 0.0)),
            ("z", lambda: folds.sticking_lambda(PAIR, np.zeros((2, 3)))),
            ("z", lambda: folds.can_stick(PAIR, [0.0, np.inf])),
            ("system", lambda: folds.stick_interval(PAIR)),
            ("system", lambda: folds.stick_interval(System([[0.0]], 0.1))),
            ("system", lambda: folds.parallelogram(System(np.eye(3), 0.1))),
        )
    ),
    ("ratio", VALUE, "expected static over kinetic friction >= 1, got 0.9", lambda: StaticAboveKinetic(0.9)),
    ("friction", VALUE, "expected positive numbers, got 0.0", lambda: blowup.Blowup(Coulomb(), [1.0, 0.0])),
    ("law", VALUE, "Modified is for 2 blocks, got 3", lambda: blowup.Blowup(Modified(), [1.0, 1.0, 1.0])),
    ("entry", VALUE, "expected lambda in", lambda: blowup.Blowup(Coulomb(), [1.0]).settle(0.0, 1.5)),
    ("slip", VALUE, r"expected -1, 0 or \+1", lambda: blowup.Blowup(Coulomb(), [1.0]).sticking_modes(0.0, 0.5)),
    (
        "system", VALUE, "expected one or two blocks, got 3",
        lambda: slow_time.run_with_law(System(np.eye(3), 0.1), Coulomb(), 0.0, 0.0, 1.0),
    ),
    ("t_end", VALUE, "expected a number in", lambda: slow_time.run_with_law(ONE, Coulomb(), 0.0, 0.0, -1.0)),
]  # fmt: skip
#: What is written for plain systems, of a diagonal, one friction and one belt.
PLAIN = {
    "simulate": lambda s: simulate(s, 0.0, 0.0, 1.0, engine="moreau"),
    "sticking_lambda": lambda s: folds.sticking_lambda(s, [0.0, 0.0]),
    "can_stick": lambda s: folds.can_stick(s, [0.0, 0.0]),
    "corners": folds.corners,
    "parallelogram": folds.parallelogram,
    "continuations": lambda s: blowup.continuations(s, Coulomb(), 0.0, 0.0),
    "run_with_law": lambda s: slow_time.run_with_law(s, Coulomb(), 0.0, 0.0, 1.0),
}
COUPLED = System([[1.0, 0.2], [-0.2, 1.0]], 0.1)
TOO_MUCH = {
    "damping": (
        [[1.0, 0.0], [0.125, 1.0]],
        "damping: expected a diagonal .* got 0.125 at row 1, column 0; .*'sigmoid'",
    ),
    "static": ([1.0, 1.25], "static: expected the kinetic friction, .* got 1.25 above 1 at block 1"),
    "weakening": (Rational(1.0), r"weakening: expected none, .* got Rational\(rate=1.0\)"),
    "mass": (2.0, "mass: expected .*, all that .*folds. takes"),
    "force": (1.0, "force: expected .*, all that .*folds. takes"),
    "belt_speed": ([-0.1, -0.2], "belt_speed: expected .*, all that .*folds. takes"),
}


def of_four():
    return simulate(DRAWN, -0.7, -0.4, 1.0)


@pytest.mark.parametrize(("name", "error", "words", "call"), [*ARRAYS, *TERMS, *RUNS, *THEORY])
@pytest.mark.filterwarnings("ignore::numpy.exceptions.ComplexWarning")
def test_the_message_names_the_argument_what_is_expected_and_what_came(name, error, words, call):
    with pytest.raises(error, match=f"^{name}{words if words.startswith(',') else ': ' + words}") as refusal:
        call()
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("term", "call"),
    [
        *(("damping", call) for call in PLAIN),
        *(("static", call) for call in ("can_stick", "corners", "continuations", "run_with_law")),
        *((term, "can_stick") for term in ("weakening", "mass", "force", "belt_speed")),
    ],
)
def test_what_is_written_for_plain_systems_says_so(term, call):
    given, words = TOO_MUCH[term]
    with pytest.raises(ValueError, match=f"^{words}"):
        PLAIN[call](COUPLED.changed(**{term: given}))


@pytest.mark.parametrize("value", [np.longdouble("1e4000"), np.frombuffer(b"\x01\x00\xa0\x7f", np.float32)[0]])
def test_what_float64_does_not_hold_is_told_in_an_error_alone(value):
    with warnings.catch_warnings(action="error"), pytest.raises(ValueError, match="expected finite entries"):
        System(np.full((2, 2), value), damping=0.1)
