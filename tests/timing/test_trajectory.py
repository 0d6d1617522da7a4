from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.robot import Limits
from apex_ompl.timing import Trajectory
from apex_ompl.timing.trajectory import joined

NAMES = ("one", "two", "three")
LIMITS = Limits(*(np.full(3, v) for v in (-2.0, 3.0, 1.5, 4.0, 30.0)))


@pytest.fixture(scope="module")
def spline() -> CubicSpline:
    """Its knots are at whole microseconds."""
    rng = np.random.default_rng(4)
    times = np.append(0.0, np.cumsum(rng.integers(50_000, 400_000, 20))) / 1e6
    return CubicSpline(times, rng.normal(0.0, 0.4, (21, 3)), bc_type="clamped")


@pytest.fixture(scope="module")
def motion(spline: CubicSpline) -> Trajectory:
    return Trajectory(spline.x, spline(spline.x), spline(spline.x, 1), spline(spline.x, 2), NAMES)


def test_a_motion_is_the_piecewise_cubic_through_its_knots(spline: CubicSpline, motion: Trajectory) -> None:
    times = np.random.default_rng(1).uniform(0.0, motion.duration, 400)
    for order in range(4):
        np.testing.assert_allclose(motion(times, order), spline(times, order), rtol=1e-7, atol=1e-7)
    assert motion(times[0]).shape == (3,) and motion.dof == 3 and motion.duration == spline.x[-1]
    np.testing.assert_array_equal(motion(motion.duration), motion.positions[-1])


def test_it_stands_still_before_and_after(motion: Trajectory) -> None:
    np.testing.assert_array_equal(motion([-1.0, 99.0]), motion.positions[[0, -1]])
    for order in (1, 2, 3):
        assert not motion([-1.0, 99.0], order).any()
    for order in (-1, 4, True, 1.5):
        with pytest.raises(ParameterError, match="order"):
            motion(0.0, order)


def test_use_of_limits_is_that_of_dense_samples(motion: Trajectory) -> None:
    times = np.sort(np.append(motion.times, np.linspace(0.0, motion.duration, 200_001)))
    dense = {
        "position": np.abs((motion(times) - 0.5) / 2.5).max(),
        "velocity": np.abs(motion(times, 1) / 1.5).max(),
        "acceleration": np.abs(motion(times, 2) / 4.0).max(),
        "jerk": np.abs(motion(times, 3) / 30.0).max(),
    }
    use = motion.use(LIMITS)
    for name, share in dense.items():
        assert share <= use[name] * (1.0 + 1e-12) and use[name] == pytest.approx(share, rel=1e-6), name
    with pytest.raises(ParameterError, match="limits"):
        motion.use(Limits(*(np.ones(2),) * 5))


def test_jerk_is_its_mean_square_and_smooth_motions_have_an_arc_nearer_to_zero(motion: Trajectory) -> None:
    times = np.linspace(0.0, motion.duration, 400_001)[:-1]
    assert motion.jerk == pytest.approx(np.sqrt(np.mean(np.sum(motion(times, 3) ** 2, axis=1))), rel=1e-3)
    times = np.linspace(0.0, 1.0, 50)
    bell = CubicSpline(times, (times**3 * (10 - 15 * times + 6 * times**2))[:, None], bc_type="clamped")
    smooth = Trajectory(times, bell(times), bell(times, 1), bell(times, 2), ("one",))
    assert motion.spectral_arc_length < smooth.spectral_arc_length < 0.0
    still = Trajectory(np.zeros(1), np.ones((1, 2)), np.zeros((1, 2)), np.zeros((1, 2)), ("a", "b"))
    assert still.duration == still.jerk == still.spectral_arc_length == 0.0
    np.testing.assert_array_equal(still([-1.0, 0.0, 5.0]), np.ones((3, 2)))
    assert len(list(still.stream())) == 1 and not still(0.5, 1).any()


def test_samples_and_streams_end_at_the_end(motion: Trajectory) -> None:
    made = motion.sample(0.01)
    assert made.time[0] == 0.0 and made.time[-1] == motion.duration and np.all(np.diff(made.time) > 0.0)
    assert np.diff(made.time).max() <= 0.01 + 1e-12
    stream = list(motion.stream(1000.0))
    assert len(stream) == int(np.ceil(motion.duration * 1000.0)) + 1
    np.testing.assert_array_equal(stream[123].velocity, motion(0.123, 1))
    np.testing.assert_array_equal(stream[-1].position, motion.positions[-1])
    for wrong in (0.0, -1.0, np.nan, np.inf, "x", 1e-300):
        with pytest.raises(ParameterError):
            motion.sample(wrong)
        if wrong != 1e-300:
            with pytest.raises(ParameterError):
                motion.stream(wrong)
        with pytest.raises(ParameterError):
            motion(np.nan)
    assert next(motion.stream(1e12)).time == 0.0, "nothing but what is asked for is made"


def test_motions_are_slowed_cut_and_joined(motion: Trajectory) -> None:
    times, slow = np.linspace(0.0, motion.duration, 97), motion.slower(2.5)
    for order in range(4):
        np.testing.assert_allclose(slow(2.5 * times, order), motion(times, order) / 2.5**order, rtol=1e-6, atol=1e-9)
    cut = motion.after(1.0)
    np.testing.assert_allclose(cut(times), motion(times + 1.0), atol=1e-12)
    np.testing.assert_allclose(cut(times[1:9], 2), motion(times[1:9] + 1.0, 2), atol=1e-9)
    assert motion.after(99.0).duration == 0.0
    states = motion.positions[::-1], -motion.velocities[::-1], motion.accelerations[::-1]
    whole = joined([motion, Trajectory(motion.duration - motion.times[::-1], *states, NAMES)])
    assert whole.duration == pytest.approx(2.0 * motion.duration)
    np.testing.assert_allclose(whole(motion.duration + times), motion(motion.duration - times), atol=1e-9)


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".traj.yaml", ".traj.json"])
def test_files_give_the_same_motion_back(motion: Trajectory, tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"motion{suffix}"
    motion.save(file)
    again = Trajectory.load(file)
    assert again.joint_names == NAMES
    np.testing.assert_array_equal(again.times, motion.times)
    for name, digits in (("positions", 12), ("velocities", 12), ("accelerations", 12)):
        rounding = 0.0 if suffix == ".npz" else 0.51 * 10.0**-digits
        given, wanted = getattr(again, name), getattr(motion, name)
        np.testing.assert_allclose(given, wanted, rtol=0.0, atol=rounding)
        np.testing.assert_array_equal(given[[0, -1]], wanted[[0, -1]])
    times = np.linspace(0.0, motion.duration, 333)
    np.testing.assert_allclose(again(times), motion(times), atol=1e-8)


def test_messages_are_those_of_ros(motion: Trajectory, tmp_path: Path) -> None:
    motion.save(tmp_path / "m.traj.yaml")
    message = yaml.safe_load((tmp_path / "m.traj.yaml").read_text())
    assert set(message) == {"header", "joint_names", "points"} and message["joint_names"] == list(NAMES)
    for k in (0, 7, -1):
        point = message["points"][k]
        assert set(point) == {"positions", "velocities", "accelerations", "effort", "time_from_start"}
        stamp = point["time_from_start"]
        assert isinstance(stamp["sec"], int) and 0 <= stamp["nanosec"] < 10**9
        assert stamp["sec"] + 1e-9 * stamp["nanosec"] == pytest.approx(motion.times[k], abs=1e-9)
    controllers = {"b_controller": ["three"], "a_controller": ["two", "one"]}
    motion.save(tmp_path / "m.traj.json", controllers)
    messages = json.loads((tmp_path / "m.traj.json").read_text())
    assert list(messages) == ["b_controller", "a_controller"]
    assert messages["a_controller"]["points"][3]["positions"] == pytest.approx(motion.positions[3, [1, 0]], abs=1e-12)
    again = Trajectory.load(tmp_path / "m.traj.json")
    assert again.joint_names == ("three", "two", "one")
    np.testing.assert_allclose(again.velocities, motion.velocities[:, [2, 1, 0]], atol=1e-9)
    motion.save(tmp_path / "m.traj.yaml", controllers)
    assert yaml.safe_load((tmp_path / "m.traj.yaml").read_text()) == messages
    wrongs = (
        {"a": ["one", "two"]},
        {"a": [*NAMES, "four"]},
        {"a": [*NAMES], "b": ["one"]},
        list(NAMES),
        {"a": 3},
        {"a": "one"},
    )
    for wrong in wrongs:
        with pytest.raises(ParameterError, match="controllers: expected"):
            motion.save(tmp_path / "x.traj.yaml", wrong)
    with pytest.raises(ParameterError, match="controllers"):
        motion.save(tmp_path / "x.csv", {"a": list(NAMES)})
    assert not list(tmp_path.glob("x*"))


def test_columns_of_a_table_have_names(motion: Trajectory, tmp_path: Path) -> None:
    motion.save(tmp_path / "m.csv")
    head, first, *_ = (tmp_path / "m.csv").read_text().splitlines()
    assert head.split(",")[:5] == ["time", "one", "two", "three", "one_velocity"]
    assert [float(v) for v in first.split(",")[:4]] == [0.0, *motion.positions[0]]


def test_faulty_files_are_named(motion: Trajectory, tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="ending in"):
        motion.save(tmp_path / "m.txt")
    with pytest.raises(MissingFileError, match="does not exist"):
        motion.save(tmp_path / "no" / "m.csv")
    with pytest.raises(MissingFileError, match="no such file"):
        Trajectory.load(tmp_path / "m.csv")
    motion.save(tmp_path / "good.csv")
    table = (tmp_path / "good.csv").read_text()
    point = "positions: [0.5], velocities: [0], accelerations: [0], time_from_start: {nanosec: 0, sec: "
    message = f"joint_names: [a]\npoints: [{{{point}0}}}}, {{{point}1}}}}]\n"
    (tmp_path / "good.traj.yaml").write_text(message)
    assert Trajectory.load(tmp_path / "good.traj.yaml").duration == 1.0
    contents = {
        "a.csv": b"time,one\n0,1\n", "b.npz": b"PK", "c.traj.json": b"{}",
        "d.traj.yaml": b"points: [1]\njoint_names: []\n",
        "e.csv": table.replace("0.0", "nan", 1).encode(), "f.csv": table.splitlines()[0].encode(),
        "g.traj.yaml": b"[1]",
        "h.csv": b"\xff\xfe", "i.traj.yaml": b"a: {points: [], joint_names: []}\nb: 3\n", "j.npz": b"",
        "k.csv": b"time,a,a_velocity,a_acceleration\n0,0,0,0\n1,9,0,0\n",
        "l.csv": b"time,a,a_velocity,a_acceleration\n0,0,0,inf",
        "m.csv": ("time," + 200_000 * "x").encode(),
        "n.traj.yaml": message.replace("0.5", "'0.5'").encode(),
        "o.traj.yaml": message.replace("sec: 1", "sec: '1'").encode(),
    }  # fmt: skip
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileFormatError, match=name):
            Trajectory.load(tmp_path / name)


def test_faulty_knots_are_refused(motion: Trajectory) -> None:
    good = {name: getattr(motion, name) for name in ("times", "positions", "velocities", "accelerations")}
    for change in (
        {"times": [0.0, np.inf]}, {"positions": "abc"}, {"positions": good["positions"] + np.eye(21, 3)},
        {"times": 0.0},
        {"times": good["times"][::-1]}, {"times": good["times"] + 1.0}, {"times": good["times"][:-1]},
        {"positions": good["positions"][:, :2]}, {"velocities": good["velocities"] * np.nan},
    ):  # fmt: skip
        with pytest.raises(ParameterError):
            Trajectory(**{**good, **change}, joint_names=NAMES)
    with pytest.raises(ParameterError, match="each once"):
        Trajectory(**good, joint_names=("one", "two", "two"))


@settings(max_examples=60)
@given(seed=st.integers(0, 10**6), pieces=st.integers(1, 6), still=st.booleans())
def test_extremes_are_those_of_dense_samples(seed: int, pieces: int, still: bool) -> None:
    rng = np.random.default_rng(seed)
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 1.0, pieces))])
    states = [rng.normal(size=(3, 4))]
    for length in np.diff(times):
        q, v, a = states[-1]
        j = rng.normal(size=4) * (0.0 if still else 1.0) * rng.choice([0.0, 1.0, 5.0], 4)
        states.append(
            np.stack([
                q + length * (v + length * (a / 2.0 + length * j / 6.0)), v + length * (a + length * j / 2.0),
                a + length * j,
            ])
        )  # fmt: skip
    rows = np.stack(states, axis=1)
    motion = Trajectory(times, *rows, tuple("abcd"))
    ones = np.ones(4)
    limits = Limits(-2.0 * ones, 4.0 * ones, 2.0 * ones, 3.0 * ones, 4.0 * ones)
    dense = np.linspace(0.0, motion.duration, 20_001)
    wanted = {
        "position": np.abs((motion(dense) - 1.0) / 3.0).max(), "velocity": np.abs(motion(dense, 1)).max() / 2.0,
        "acceleration": np.abs(motion(dense, 2)).max() / 3.0, "jerk": np.abs(motion.jerks).max() / 4.0,
    }  # fmt: skip
    found = motion.use(limits)
    for name, value in wanted.items():
        assert value - 1e-12 <= found[name] <= value + 2e-3 * (1.0 + value), name
    slow = motion.slower(2.0).use(limits)
    again = Trajectory(2.0 * times, rows[0], rows[1] / 2.0, rows[2] / 4.0, tuple("abcd")).use(limits)
    assert slow == pytest.approx(again, rel=1e-12)


@pytest.mark.parametrize("begin", [0.0, 1.2, 29.0])
def test_rounding_between_knots_that_nearly_meet_is_no_jerk(begin: float) -> None:
    """One joint of constant jerk 5000, with knots 1e-10 s apart, which its clock's time rounds: no limit is passed."""
    wide = np.array([1e4])
    limits = Limits(-wide, wide, wide, wide, np.array([5000.0]))
    gaps = np.cumsum(np.random.default_rng(1).uniform(1e-10, 2e-10, 20))
    since = np.concatenate([[0.0, 0.002], 0.002 + gaps, [0.01]])[:, None]
    states = np.stack([5000.0 * since**3 / 6.0, 5000.0 * since**2 / 2.0, 5000.0 * since])
    motion = Trajectory.unchecked((begin + since)[:, 0], states, ("joint",))
    assert 1.0 - 1e-9 <= motion.use(limits)["jerk"] <= 1.0 + 1e-9
    assert motion.jerks.max() > 5000.0 * (1.0 + 2e-9)
