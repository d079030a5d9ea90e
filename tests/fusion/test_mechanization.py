"""Strapdown integration against the simulator's exact motion and against analytic coning."""

from itertools import pairwise
from typing import Literal

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion.events import OUTPUT
from fusion.navigator import feed
from fusion.timeline import parameters
from sensors._kernels import EARTH_RATE, gravity_enu
from sensors.geodesy import ecef_from_llh
from sensors.records import Imu
from sensors.simulate.trajectory import Truth
from sensors.vehicle import Vehicle
from tests.fusion.free import FREE, city, core_at, distance, exact_imu, go, go_with, grid, nav_of, nothing

Floats = NDArray[np.float64]
Samples = Literal["rate", "increment"]
DURATION_S = 300.0
CONE_RAD = np.radians(1.0)
CONE_RATE = 2 * np.pi * 5.0
PLACE = np.array([0.84, 0.2, 560.0])


@pytest.fixture(scope="module")
def truth() -> Truth:
    return city(DURATION_S)


def vehicle(samples: Samples) -> Vehicle:
    return Vehicle(imu=msgspec.structs.replace(Vehicle().imu, samples=samples))


def end(truth: Truth, samples: Samples, hz: int) -> Floats:
    """(16,) state after a free run without errors."""
    t = grid(truth, DURATION_S, hz)
    imu = exact_imu(truth, t, vehicle(samples))
    core = core_at(nav_of(truth.at(t[:1])), imu)
    go(core, imu, vehicle(samples))
    return core.nav


def apart(a: Floats, b: Floats) -> float:
    """Metres in 3-D between two states."""
    p = ecef_from_llh(np.stack((a[:3], b[:3])))
    return float(np.linalg.norm(p[0] - p[1]))


@pytest.mark.parametrize("samples", ["rate", "increment"])
def test_300_s_without_errors_end_within_a_centimetre(truth: Truth, samples: Samples) -> None:
    nav = end(truth, samples, 100)
    last = truth.at(grid(truth, DURATION_S, 100)[-1:])
    error = distance(nav, last)
    print(f"{samples}: 300 s at 100 Hz end {error * 1e3:.3f} mm from the truth")
    assert error < 1e-3  # ten times better than the centimetre that is asked for
    assert np.abs(nav[3:6] - last.vel_enu[0]).max() < 1e-5
    turned = Rotation.from_quat(nav[6:10]) * Rotation.from_quat(last.q_enu_body[0]).inv()
    assert turned.magnitude() < 1e-6


@pytest.mark.parametrize("samples", ["rate", "increment"])
def test_error_falls_at_second_order_or_better(truth: Truth, samples: Samples) -> None:
    """Differences between rates: what does not depend on the rate (gravity between refreshes, 0.03 mm) cancels."""
    navs = [end(truth, samples, hz) for hz in (50, 100, 200, 400)]
    steps = [apart(a, b) for a, b in pairwise(navs)]
    order = np.log2(np.array(steps[:-1]) / steps[1:])
    print(f"{samples}: order of the position {order.round(2)}")
    assert (order > 1.9).all()
    velocity = [np.linalg.norm(a[3:6] - b[3:6]) for a, b in pairwise(navs)]
    assert (np.log2(np.array(velocity[:-1]) / velocity[1:]) > 1.9).all()


@pytest.mark.parametrize("samples", ["rate", "increment"])
def test_events_between_samples_do_not_change_the_trajectory(truth: Truth, samples: Samples) -> None:
    """A split interval is integrated as one curve: what is left is the scheme's own error over shorter steps."""
    t = grid(truth, DURATION_S, 100)
    imu = exact_imu(truth, t, vehicle(samples))
    first, whole = nav_of(truth.at(t[:1])), end(truth, samples, 100)

    def moved(at: NDArray[np.int64]) -> float:
        core = core_at(first, imu)
        go_with(core, imu, vehicle(samples), at, OUTPUT)
        return apart(core.nav, whole)

    assert moved(t[1:].copy()) == 0.0  # on the samples: the same operations
    rng = np.random.default_rng(0)
    assert moved(rng.integers(t[0] + 1, t[-1], 1)) < 1e-8
    assert moved(np.sort(rng.integers(t[0] + 1, t[-1], 100))) < 1e-6
    assert moved(np.sort(rng.integers(t[0] + 1, t[-1], 12_000))) < 1e-5  # 40 a second: most events fall inside


def coning(samples: Samples, hz: int, seconds: int) -> tuple[Imu, Rotation]:
    """A body at rest on the earth whose axis cones by 1 deg at 5 Hz: its samples and its attitudes at their stamps."""
    t = np.arange(seconds * hz + 1) / hz
    earth = EARTH_RATE * np.array([0.0, np.cos(PLACE[0]), np.sin(PLACE[0])])
    north, up = gravity_enu(np.sin(PLACE[0]), np.cos(PLACE[0]), PLACE[2])

    def attitude(at: Floats) -> Rotation:
        phase = CONE_RATE * at
        return Rotation.from_rotvec(CONE_RAD * np.stack((np.cos(phase), np.sin(phase), 0 * at), axis=-1))

    def signals(at: Floats) -> Floats:
        """(N, 6): w sin(a) (-sin, cos) across, -2 w sin^2(a/2) along, with the earth's rate; gravity's reaction."""
        phase, across = CONE_RATE * at, CONE_RATE * np.sin(CONE_RAD)
        along = np.full(len(at), -2 * CONE_RATE * np.sin(CONE_RAD / 2) ** 2)
        rate = np.stack((-across * np.sin(phase), across * np.cos(phase), along), axis=-1)
        to_body = attitude(at).inv()
        return np.hstack((rate + to_body.apply(earth), to_body.apply([0.0, -north, -up])))

    if samples == "rate":
        rows = signals(t)
    else:
        nodes, weights = np.polynomial.legendre.leggauss(5)
        rows = sum(
            0.5 * weight * signals(t + 0.5 * (node - 1.0) / hz) for node, weight in zip(nodes, weights, strict=True)
        )
    t_ns = np.rint(t * 1e9).astype(np.int64)
    return Imu(t_ns, t_ns, rows[:, :3], rows[:, 3:]), attitude(t)


@pytest.mark.parametrize("samples", ["rate", "increment"])
def test_coning_is_followed_at_fourth_order(samples: Samples) -> None:
    """Without the coning term the axis would turn by w sin^2(a)/2 = 16.4 deg in 60 s."""
    drift = []
    for hz in (50, 100, 200):
        imu, attitude = coning(samples, hz, 60)
        core = core_at(np.concatenate((PLACE, np.zeros(3), attitude[0].as_quat(), np.zeros(7))), imu)
        go(core, imu, vehicle(samples))
        error = (Rotation.from_quat(core.nav[6:10]) * attitude[-1].inv()).as_rotvec()
        drift.append(abs(np.degrees(error[2])))
        assert np.abs(error[:2]).max() < np.radians(0.05)
    print(f"{samples}: coning drift in 60 s at 50, 100, 200 Hz: {np.round(drift, 5)} deg")
    assert drift[1] < 1e-3 * 16.4
    assert (np.log2(np.array(drift[:-1]) / drift[1:]) > 3.8).all()


def test_horizontal_drift_over_two_hours_with_height_held() -> None:
    """Schuler-bound: what is left comes from the integrator alone. Free height would be unstable by nature."""
    truth, rover, seconds = city(7200.0, 5), Vehicle(), 7200
    t = grid(truth, seconds, 100)
    imu, motion = exact_imu(truth, t, rover), truth.at(t)
    core, par = core_at(nav_of(motion), imu), parameters(rover, FREE)
    events, measurements, rec = nothing(rover)
    drift = np.empty(seconds)
    for second in range(seconds):
        last = 100 * (second + 1)
        feed(core, imu[last - 99 : last + 1], events, measurements, par, rec)
        core.nav[2], core.nav[5] = motion.llh[last, 2], motion.vel_enu[last, 2]
        drift[second] = distance(core.nav, motion, last)
    at = {minutes: round(float(drift[minutes * 60 - 1]) * 1e3, 2) for minutes in (5, 30, 60, 120)}
    print(f"horizontal drift, mm after minutes: {at}; largest {drift.max() * 1e3:.2f} mm")
    assert drift.max() < 0.02
