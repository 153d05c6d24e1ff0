"""Records that measure a run after t_burn: closed forms of one block, and sums by hand of many."""

import numpy as np
import pytest
from scipy.integrate import quad

from stickslip import Dataset
from stickslip.pipeline import SceneError, load_scene, parse_scene, run_ensemble
from stickslip.pipeline.ensemble.expand import expand
from stickslip.pipeline.records.motion.amplitude import Amplitude

ASKED = ("amplitude", "slip_speed", "stick_share", "first_exit", "waiting", "friction_power")
SOURCE = """\
[system]
coupling = "chain"
n = BLOCKS
kappa = 1.0
leaf = 1.0
damping = 0.0
static = STATIC
belt_speed = SPEED
[start]
z = START
w = "belt"
[run]
t_end = END
matrices = 1
seed = SEED
[[engine]]
name = "coulomb"
tol = 1e-10
[record]
dt = DT
t_burn = BURN
ASKED
[analysis]
t_burn = 0.0
dt = 0.5
"""


def scene_of(asked=ASKED, **words):
    source = SOURCE.replace("ASKED", "\n".join(f"{one} = true" for one in asked))
    for word, value in words.items():
        source = source.replace(word, str(value))
    return parse_scene(source.encode())


def test_one_block_in_its_cycle(rng, tmp_path):
    """A block on a spring: it sticks for 2 d / v, then turns on a circle of radius sqrt(d^2 + v^2) round z = 1."""
    d, v = rng.uniform(0.2, 0.8), rng.uniform(0.1, 0.5)
    radius, slips = np.hypot(d, v), np.pi + 2 * np.arctan2(v, d)
    period = 2 * d / v + slips
    burn = (1 + d) / v + 0.3 * period
    scene = scene_of(
        BLOCKS=1, STATIC=1 + d, SPEED=v, START=0.0, END=burn + 7 * period, SEED=0, BURN=burn, DT=period / 2000
    )
    run_ensemble(scene, tmp_path / "out", workers=0)
    row = Dataset(tmp_path / "out").members.iloc[0]
    assert row["amplitude"] == pytest.approx(radius, abs=1e-9)
    assert row["amplitude_mean"] == row["amplitude"]
    assert row["slip_speed"] == pytest.approx(v, rel=1e-5)  # as the block comes back
    square, _ = quad(lambda s: (v - radius * np.cos(s + np.arctan2(d, v))) ** 2, 0, slips, epsabs=1e-12)
    assert row["slip_speed_rms"] == pytest.approx(np.sqrt(square / period), rel=1e-5)
    assert row["friction_power"] == pytest.approx(v, rel=1e-5)
    assert row["stick_share"] == pytest.approx(2 * d / v / period, rel=1e-8)
    assert row["never_slipped"] == 0
    assert (row["first_exit"], row["first_exit_block"]) == (pytest.approx((1 + d) / v, rel=1e-9), 0)
    assert row["waiting_count"] == 6
    assert row["waiting_mean"] == pytest.approx(period, rel=1e-8)
    assert row["waiting_cv"] < 1e-8


def test_the_last_state_is_not_lost_by_rounding(tmp_path):
    """0.3 / 0.1 < 3 in floating point, and 3 * 0.1 > 0.3: a block that rides its belt throughout goes 0.3 v."""
    scene = scene_of(BLOCKS=1, STATIC=1.5, SPEED=0.4, START=0.0, END=0.3, SEED=0, BURN=0.0, DT=0.1)
    run_ensemble(scene, tmp_path / "out", workers=0)
    assert Dataset(tmp_path / "out").members["amplitude"].tolist() == pytest.approx([0.3 * 0.4 / 2], rel=1e-12)


def test_many_blocks_by_hand(rng, tmp_path):
    """Against sums over the events of each block, and extremes of a fine sampling."""
    n, burn, end, dt = 12, 20.0, 60.0, 0.05
    words = {"BLOCKS": n, "STATIC": 1.3, "SPEED": -0.2, "START": "{uniform = [-0.5, 0.5]}", "END": end, "BURN": burn}
    scene = scene_of(**words, SEED=int(rng.integers(2**31)), DT=dt)
    run_ensemble(scene, tmp_path / "out", workers=0)
    row = Dataset(tmp_path / "out").members.iloc[0]
    t = np.linspace(burn, end, 400_001)
    run = next(iter(expand(scene))).simulate(t)
    modes = run.events.mode_at(burn)
    sticks, gaps, never = 0.0, [], 0
    for block in range(n):
        own = run.events.block == block
        times = np.concatenate([[burn], run.events.t[own & (run.events.t > burn)], [end]])
        mode = np.concatenate([[modes[block]], run.events.mode[own & (run.events.t > burn)]])
        sticks += np.diff(times)[mode == 0].sum()
        never += len(mode) == 1 and mode[0] == 0
        gaps.extend(np.diff(times[1:-1][(mode[1:] != 0) & (mode[:-1] == 0)]))
    assert row["stick_share"] == pytest.approx(sticks / (n * (end - burn)), rel=1e-9)
    assert row["never_slipped"] == never / n
    assert row["waiting_count"] == len(gaps)
    assert row["waiting_mean"] == pytest.approx(np.mean(gaps), rel=1e-9)
    assert row["waiting_cv"] == pytest.approx(np.std(gaps, ddof=1) / np.mean(gaps), rel=1e-9)
    half = np.ptp(run.samples.z, axis=0) / 2
    assert row["amplitude"] == pytest.approx(half.max(), abs=2e-5)
    assert row["amplitude_mean"] == pytest.approx(half.mean(), abs=2e-5)
    assert row["slip_speed"] == pytest.approx(np.abs(run.samples.w + 0.2).mean(), rel=1e-3)
    assert row["friction_power"] == pytest.approx(n * row["slip_speed"], rel=1e-12)


@pytest.mark.parametrize("start", [0.0, 2.0])
def test_what_does_not_slip_has_no_waiting_times(start, tmp_path):
    """From 0 blocks stick throughout, from 2 they swing to 0 at first, which takes half a period, 3.1."""
    scene = scene_of(BLOCKS=3, STATIC=1.3, SPEED=0.01, START=start, END=20.0, BURN=5.0, DT=0.1, SEED=0)
    run_ensemble(scene, tmp_path / "out", workers=0)
    row = Dataset(tmp_path / "out").members.iloc[0]
    assert (row["stick_share"], row["never_slipped"], row["waiting_count"]) == (1.0, 1.0, 0)
    assert row[["waiting_mean", "waiting_cv", "first_exit", "first_exit_block"]].isna().all()
    assert row["slip_speed"] < 1e-12
    assert row["amplitude"] == pytest.approx(0.01 * 15 / 2, rel=1e-9)


@pytest.mark.parametrize(("asked", "words", "match"), [
    (("amplitude",), {"dt = DT\n": ""}, r"record.dt: expected with `amplitude`, found nothing; write e.g. dt = 0"),
    (("first_exit",), {"dt = DT\n": ""}, r"record.t_burn: expected only with some of .*stick_share.*; remove it"),
    (("waiting",), {}, r"record.dt: expected only with some of amplitude, slip_speed.*, found none; remove it"),
    (("waiting",), {"dt = DT\n": "", "BURN": 30.0}, r"record.t_burn: expected less than run.t_end = 20.0, got 30"),
    (("amplitude",), {"DT": 1e-9}, r"record.dt: expected at least 2e-06, run.t_end / 10000000, got 1e-09"),
    (("friction_power",), {'"coulomb"\ntol = 1e-10': '"sigmoid"\neps = 0.01'},
        r"record.friction_power: expected an engine of"),
])  # fmt: skip
def test_what_does_not_apply_is_refused(asked, words, match):
    usual = {"BLOCKS": 1, "STATIC": 1.3, "SPEED": 0.1, "START": 0.0, "END": 20.0, "BURN": 5.0, "DT": 0.1, "SEED": 0}
    with pytest.raises(SceneError, match=match):
        scene_of(asked, **words, **{word: value for word, value in usual.items() if word not in words})


def test_records_are_taken_in_the_order_of_their_keys():
    for asked in (("waiting", "amplitude", "stick_share"), ("stick_share", "waiting", "amplitude")):
        scene = scene_of(asked, BLOCKS=3, SPEED=-0.2, STATIC=1.2, START=0.0, END=10.0, SEED=0, DT=0.1, BURN=1.0)
        assert [one.name for one in scene.records_in_order][:3] == list(asked)
        assert {one.name for one in scene.records_in_order} == {one.name for one in scene.records}


def test_t_burn_of_the_analysis_counts_where_a_record_takes_it():
    words = {"BLOCKS": 1, "STATIC": 1.3, "SPEED": 0.1, "START": 0.0, "END": 20.0, "SEED": 0, "t_burn = BURN\n": ""}
    one = scene_of(("amplitude",), **words, DT=0.1)
    assert one.records == (Amplitude(0.0, 0.1),)
    assert one.changed(analysis={"t_burn": 1.0}).hash != one.hash
    none = scene_of(("first_exit",), **words, **{"dt = DT\n": ""})
    assert none.changed(analysis={"t_burn": 1.0}).hash == none.hash


def bit(tmp_path, **keys):
    """A column of blocks without friction above one that sticks and slips, driven from above by their springs."""
    tmp_path.joinpath("strings.py").write_text(
        "import numpy as np\n"
        "from stickslip import System\n\n\n"
        "def bit(n, rng):\n"
        "    K = np.eye(n)\n"
        "    friction, static = np.zeros(n), np.zeros(n)\n"
        "    friction[-1], static[-1] = 1.0, 1.5\n"
        "    belts = np.full(n, 50.0)\n"
        "    belts[-1] = 0.2\n"
        "    return System(K, 0.0, friction, belts, static)\n"
    )
    asked = "".join(f"{name} = true\n" for name in (*ASKED, "attractor", "end"))
    text = f"""start = "rest"
[system]
coupling = "strings:bit"
n = {keys["n"]}
[run]
t_end = 100.0
matrices = 1
[[engine]]
name = "coulomb"
tol = 1e-10
[record]
dt = 0.01
t_burn = 50.0
{asked}
[analysis]
t_burn = 0.0
dt = 0.5
"""
    file = tmp_path / f"bit{keys['n']}.toml"
    file.write_text(text)
    run_ensemble(load_scene(file), tmp_path / f"out{keys['n']}", workers=0)
    return Dataset(tmp_path / f"out{keys['n']}").members.iloc[0]


def test_blocks_without_friction_are_no_contacts(tmp_path):
    """Beside four of them, which pull nothing, one block has the numbers that it has alone."""
    alone, beside = (bit(tmp_path, n=n) for n in (1, 5))
    assert (alone["n_contacts"], beside["n_contacts"]) == (1, 1)
    names = ["stick_share", "never_slipped", "slip_speed", "slip_speed_rms", "friction_power", "first_exit", "period"]
    for name in (*names, "waiting_count", "waiting_mean", "exits_per_period", "events_per_period"):
        assert beside[name] == pytest.approx(alone[name], rel=1e-9), name
    assert 0 < alone["stick_share"] < 1
    assert beside["amplitude_mean"] == pytest.approx(alone["amplitude_mean"] / 5, rel=1e-6)  # the four stay at rest


def test_the_block_that_lets_go_first_is_one_with_friction(tmp_path):
    """The middle of three is pushed until its static friction gives way; the others only ride until then."""
    text = """[system]
coupling = "chain"
n = 3
kappa = 1.0
leaf = 1.0
damping = 0.1
friction = 1.0
static = 1.3
contacts = [1]
belt_speed = 0.0
force = {amplitude = 4.0, frequency = 0.3, blocks = [2]}
[start]
z = 0.0
w = 0.0
[run]
t_end = 20.0
matrices = 1
[[engine]]
name = "coulomb"
[record]
first_exit = true
events = true
[analysis]
t_burn = 0.0
dt = 0.5
"""
    run_ensemble(parse_scene(text.encode()), tmp_path / "out", workers=0)
    dataset = Dataset(tmp_path / "out")
    row = dataset.members.iloc[0]
    events = dataset.events(row["member_id"])
    assert 0 in events.block[events.is_exit], "a block without friction leaves the belt too"
    exits = events.t[events.is_exit & (events.block == 1)]
    assert (row["first_exit"], row["first_exit_block"]) == (exits[0], 1)


def test_without_any_contact_its_numbers_are_null(tmp_path):
    scene = scene_of(
        ("stick_share", "slip_speed", "waiting"),
        BLOCKS=2, STATIC="0.0\nfriction = 0.0", SPEED=0.1, START=0.5, END=20.0, BURN=5.0, DT=0.1, SEED=0,
    )  # fmt: skip
    run_ensemble(scene, tmp_path / "out", workers=0)
    row = Dataset(tmp_path / "out").members.iloc[0]
    assert (row["n_contacts"], row["waiting_count"], row["w0"]) == (0, 0, 0.0)
    assert row[["stick_share", "never_slipped", "slip_speed", "slip_speed_rms"]].isna().all()
