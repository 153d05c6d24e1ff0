"""A drive in a line: the frame that moves with it, against a motion that is followed on the ground, and refusals."""

import numpy as np
import pytest

from stickslip import Harmonic, Piecewise, Scene, System, simulate
from stickslip.pipeline import SceneError, expand
from tests.pipeline.drill import bit_events

NAMES = ["table", "pipe", "collar", "bit"]


def scene(drive=(), engine=(), **system):
    drive = {"block": "table", "spring": 2.0, "speed": 0.1} | dict(drive)
    return Scene(
        system={
            "coupling": "chain", "n": 4, "kappa": 1.5, "leaf": 0.0, "names": NAMES, "contacts": ["bit"], "mass": 1.3,
            "friction": 0.3, "static": 0.45, "rayleigh": [0.005, 0.01], "drive": drive,
        } | system,
        start="rest",
        run={"t_end": 100.0, "matrices": 1},
        engine=[{"name": "coulomb", "tol": 1e-12} | dict(engine)],
        analysis={"t_burn": 10.0, "dt": 0.5},
    )  # fmt: skip


HARMONIC = ("amplitude", "frequency", "phase")
#: A speed of the drive that comes to one, after it has begun at another, and one that does not.
COURSES = (([0.0, 8.0, 30.0, 40.0], [0.1, 0.2, 0.1, 0.1]), ([-3.0, 9.0, 33.0, 80.0], [0.1, 0.1, 0.2, 0.1 / 3]))


@pytest.mark.parametrize(
    "harmonic",
    [{}, {"amplitude": 0.05, "frequency": 0.7, "phase": 0.4}]
    + [{"speed": {"times": t, "values": v}} for t, v in COURSES],
)
def test_events_are_those_of_an_own_integration_on_the_ground(harmonic):
    (member,) = expand(scene(drive=harmonic))
    course = harmonic.get("speed")
    frame = -member.system().belt_speed
    run = member.simulate() if course is None else simulate(member.system(), 0.0, [0.1 - frame] * 3 + [-frame], 100.0)
    laplacian = np.diag([1.0, 2.0, 2.0, 1.0]) - np.eye(4, k=1) - np.eye(4, k=-1)
    stiffness, mass = 1.5 * laplacian, np.full(4, 1.3)
    swing, omega, phi = (harmonic.get(key, 0.0 if key == "amplitude" else 1.0) for key in HARMONIC)

    def place(t):
        if course is not None:
            knots = np.array([0.0, *(x for x in course["times"] if 0.0 < x < t), t])
            return np.trapezoid(pace(knots), knots)
        return 0.1 * t + swing / omega * (np.sin(omega * t + phi) - np.sin(phi))

    def pace(t):
        if course is not None:
            return np.interp(t, course["times"], course["values"])
        return 0.1 + swing * np.cos(omega * t + phi)

    drive = (0, 2.0, 0.01 * 2.0, place, pace)
    damping = np.diag(0.005 * mass) + 0.01 * stiffness
    expected = bit_events(stiffness, damping, mass, 0.3, drive, 3, 0.1, 100.0, static=0.45)
    is_bit = run.events.block == 3
    assert len(expected) > 3
    assert [mode for _, mode in expected] == run.events.mode[is_bit].tolist()
    np.testing.assert_allclose(
        [t for t, _ in expected], run.events.t[is_bit], rtol=0, atol=1e-8 if course is None else 1e-4
    )


def test_the_frame_is_that_of_the_drive():
    lab = System([[1.0, -1.0], [-1.0, 1.0]], [0.1, 0.2], [0.0, 0.5], 0.0, force=[0.0, 0.3], names=["top", "bit"])
    frame = lab.driven("top", spring=2.0, speed=0.4, damping=0.05, amplitude=0.1, frequency=2.0)
    assert np.array_equal(frame.stiffness, [[3.0, -1.0], [-1.0, 1.0]])
    assert frame.damping.tolist() == [0.1 + 0.05, 0.2]
    assert frame.belt_speed == -0.4
    constant, *others = frame.force
    assert constant.at(0.0) == pytest.approx([-0.04, 0.3 - 0.08])
    assert all(isinstance(term, Harmonic) for term in others)
    moving = lab.changed(belt_speed=Piecewise([0.0, 1.0], [0.0, 0.2])).driven("bit", spring=1.0, speed=0.4)
    assert moving.belt_speed_at(1.0) == pytest.approx([-0.2, -0.2])
    one_way = System(np.zeros((1, 1)), 0.0, 1.0, -0.1, back_slip=False).driven(0, spring=1.0, speed=-0.3)
    assert one_way.closed.tolist() == [1]  # the belt now goes the other way


def test_a_sweep_of_the_drive_and_the_members_that_it_makes():
    swept = scene(drive={"speed": [0.1, 0.2]}, back_slip=False)
    members = list(expand(swept))
    assert ["drive_speed=0.1" in member.member_id for member in members] == [True, False]
    for member in members:
        speed = member.term("drive_speed")
        system = member.system()
        assert system.belt_speed == -speed
        assert not system.back_slip
        assert system.has_friction.tolist() == [False, False, False, True]
        assert system.at_rest(0.0).tolist() == [0.0, 0.0, 0.0, -speed]
        assert member.row()["w0"] is None


@pytest.mark.parametrize(("drive", "system", "why"), [
    ({"block": "derrick"}, {}, "drive.block: expected one of table, pipe, collar, bit, got 'derrick'"),
    ({"block": 4}, {}, "drive.block: expected an integer from 0 to 3, got 4"),
    ({"block": ["table"]}, {}, "block"),
    ({"spring": 0.0}, {}, "expected a finite number > 0"),
    ({"spring": None}, {}, "spring: expected the stiffness of the spring between the drive"),
    ({"speed": {"times": [0.0, 1.0], "values": [0.0]}}, {}, "drive.speed: expected times that increase"),
    ({"speed": {"table": "speed.csv"}}, {}, "drive.speed: speed.csv cannot be read"),
    ({"speed": [{"times": [0.0], "values": [0.0]}]}, {}, "drive.speed: expected no course in a list"),
    ({"tension": 3.0}, {}, "unknown key"),
    ({}, {"contacts": ["bit", "bit"]}, "contacts: expected each block once"),
    ({}, {"contacts": []}, "contacts: expected each block once, and some"),
    ({}, {"contacts": ["tool joint"]}, "contacts: expected one of table"),
])  # fmt: skip
def test_a_drive_that_is_none_is_refused(drive, system, why):
    with pytest.raises(SceneError) as error:
        scene(drive=drive, **system)
    assert why in str(error.value)


def test_what_no_frame_expresses_is_refused():
    (torn,) = expand(scene(leaf=0.1))
    with pytest.raises(ValueError, match=r"rows that sum to 0, got 0\.1 at block table"):
        torn.system()
    with pytest.raises(SceneError, match=r'drive: expected none, all that .* name = "moreau" takes'):
        scene(engine={"name": "moreau", "tol": None}, static=None, rayleigh=None).check_engines()
    free = System([[0.0]], 0.1, belt_speed=0.0)
    with pytest.raises(TypeError, match="speed: expected a number or a Piecewise, got Harmonic"):
        free.driven(0, spring=1.0, speed=Harmonic(1.0, 1.0))
    with pytest.raises(ValueError, match=r"speed: expected one value at each time, got the shape \(2, 1\)"):
        free.driven(0, spring=1.0, speed=Piecewise([0.0, 1.0], [[0.0], [1.0]]))
    with pytest.raises(ValueError, match="block: expected a number from 0 to 0, as these blocks have no names"):
        free.driven("bit", spring=1.0, speed=0.1)
    resting = free.changed(stiffness=[[1.0]]).driven(0, spring=1.0, speed=0.0, amplitude=2.0)  # nothing moves away
    assert simulate(resting, 0.0, 0.0, 10.0).events.t.size > 0
