"""Simulated IMU: exact rate and specific force, plus a datasheet's errors, temperature and vibration."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors._kernels import STANDARD_GRAVITY
from sensors.bounds import NonNegative, Positive
from sensors.clock import seconds
from sensors.records import Imu
from sensors.simulate import _sensor_kernels
from sensors.simulate.course import Course
from sensors.simulate.imu_presets import PRESETS, ImuFlaws, PresetName
from sensors.simulate.noise import GaussMarkov, Rng
from sensors.simulate.trajectory import Truth
from sensors.vehicle import ImuSpec

Floats = NDArray[np.float64]

DEG_PER_H = np.pi / 180 / 3600
MILLI_G = STANDARD_GRAVITY / 1000
NODE_S = 1.0
"""Biases and gains are straight lines over this long, or less where they drift faster."""
NODES_PER_TIME_CONSTANT = 50


class Temperature(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The IMU's temperature against that at power-up."""

    rise_k: NonNegative = 0.0
    """Warm-up in the end, K."""
    rise_time_s: Positive = 600.0
    """Time constant of the warm-up, s."""
    wander_k: NonNegative = 0.0
    """Standard deviation of slow changes (sun, wind, heater), K."""
    wander_time_s: Positive = 900.0
    """Correlation time of these changes, s."""


class Vibration(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Engine and road, as the IMU samples them: root mean square of each axis.

    The broadband part is the difference of successive white numbers: the body shakes about its way and does not leave
    it. The line turns with the wheels, so it folds back wherever it exceeds half the IMU's rate.
    """

    accel_idle: NonNegative = 0.0
    """Broadband acceleration at rest, m/s^2."""
    accel_per_speed: NonNegative = 0.0
    """Its growth with speed, m/s^2 per m/s."""
    gyro_idle_deg: NonNegative = 0.0
    """Broadband rate at rest, deg/s."""
    gyro_per_speed_deg: NonNegative = 0.0
    """Its growth with speed, deg/s per m/s."""
    accel_line: NonNegative = 0.0
    """Acceleration at the frequency of the wheels at 10 m/s; it grows with the speed's square, m/s^2."""
    gyro_line_deg: NonNegative = 0.0
    """Rate at that frequency at 10 m/s; it grows with the speed, deg/s."""
    wheel_circumference_m: Positive = 2.0
    """Way of one turn of the wheels, m."""


class ImuSimulation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the IMU is sampled and what shakes and warms it; its noise and biases are those of the vehicle's ImuSpec."""

    rate_hz: Annotated[float, msgspec.Meta(ge=10.0)] = 100.0
    """Sample rate, Hz."""
    errors: bool = True
    """Add the datasheet's biases and noise, flaws and vibration; without: exact samples."""
    delay_s: NonNegative = 0.001
    """From measurement to arrival, s."""
    preset: PresetName | None = None
    """A part typical of its class, in place of the vehicle's ImuSpec, with its flaws."""
    flaws: ImuFlaws | None = None
    """Scale, misalignment and sensitivity to temperature; default: the preset's, or none."""
    temperature: Temperature = Temperature()
    vibration: Vibration = Vibration()

    def part(self, spec: ImuSpec) -> tuple[ImuSpec, ImuFlaws]:
        """The IMU's datasheet and flaws, where the vehicle's says spec."""
        if self.preset is None:
            return spec, self.flaws or ImuFlaws()
        preset = PRESETS[self.preset]
        return preset.spec, preset.flaws if self.flaws is None else self.flaws


@dataclass(frozen=True, slots=True, eq=False)
class ImuBiases:
    """True biases at the IMU's stamps: sample = truth + bias + noise at rest on level ground, and everywhere without
    flaws. What scale and misalignment make of gravity is constant, and part of the accelerometer's bias: no filter
    that has no states for these can tell it apart. gyro: (N, 3) rad/s; accel: (N, 3) m/s^2.
    """

    gyro: Floats
    accel: Floats


class _Triad(NamedTuple):
    """Errors of three axes over a drive: bias and gain (K, 3) at nodes, axes (3, 3), what the third axis sees
    at rest, white noise of each sample."""

    bias: Floats
    gain: Floats
    axes: Floats
    rest: float
    white: float


class ImuSensor:
    """An IMU over one drive, some samples at a time."""

    def __init__(
        self, truth: Truth, course: Course | None, duration_s: float, spec: ImuSpec, config: ImuSimulation, rng: Rng
    ) -> None:
        """course: needed for vibration. rng: its numbers go to this drive's part, then to its noise row by row."""
        self._truth, self._course, self._config = truth, course, config
        self._spec, flaws = config.part(spec)
        self._interval_s = 1.0 / config.rate_hz
        drawn, self._noise, self._shaking = rng.spawn(3)
        self._step_s = max(self._interval_s, min(NODE_S, self._spec.bias_time_constant_s / NODES_PER_TIME_CONSTANT))
        count = int(duration_s / self._step_s) + 3
        temperature = _temperature(count, self._step_s, config.temperature, drawn)
        self._triads = _triads(self._spec, flaws, temperature, self._step_s, self._interval_s, drawn)
        phase = drawn.uniform(0.0, 2 * np.pi, (2, 3))
        self._phase = np.stack((np.cos(phase), np.sin(phase)), axis=-1)
        self._shaken = np.zeros((2, 3))

    def sense(self, t_ns: NDArray[np.int64]) -> tuple[Imu, ImuBiases]:
        """Samples at t_ns (N,), which follow the last ones, and their true biases."""
        increment = self._spec.samples == "increment"
        exact = self._truth.inertial_means(t_ns, self._interval_s) if increment else self._truth.inertial(t_ns)
        biases = np.zeros((2, len(t_ns), 3))
        if self._config.errors:
            at = np.maximum(seconds(t_ns, self._truth.start_ns) / self._step_s, 0.0)
            noise = self._noise.standard_normal((len(t_ns), 6))
            for k, triad in enumerate(self._triads):
                _sensor_kernels.add_inertial_errors(
                    exact[k],
                    biases[k],
                    at,
                    triad.bias,
                    triad.gain,
                    triad.axes,
                    triad.rest,
                    triad.white,
                    noise[:, 3 * k : 3 * k + 3],
                )
            self._shake(t_ns, exact)
        arrival_ns = t_ns + round(self._config.delay_s * 1e9)
        return Imu(t_ns, arrival_ns, *exact), ImuBiases(*biases)

    def _shake(self, t_ns: NDArray[np.int64], samples: tuple[Floats, Floats]) -> None:
        """Add the vibration to rates and forces (N, 3), in place."""
        vibration, course = self._config.vibration, self._course
        if course is None or vibration == Vibration():
            return
        way, speed = course.place(t_ns), _speed(course, t_ns)
        degree = np.pi / 180
        levels = (
            degree * (vibration.gyro_idle_deg + vibration.gyro_per_speed_deg * speed),
            vibration.accel_idle + vibration.accel_per_speed * speed,
        )
        lines = (degree * vibration.gyro_line_deg * speed / 10.0, vibration.accel_line * (speed / 10.0) ** 2)
        shaking = self._shaking.standard_normal((len(t_ns), 6))
        turns = way / vibration.wheel_circumference_m
        for k in range(2):
            white = shaking[:, 3 * k : 3 * k + 3]
            _sensor_kernels.add_vibration(
                samples[k], levels[k], lines[k], turns, self._phase[k], white, self._shaken[k]
            )


def simulate_imu(
    truth: Truth, t_ns: NDArray[np.int64], spec: ImuSpec, rng: Rng | None, delay_s: float = 0.0
) -> tuple[Imu, ImuBiases]:
    """Samples at t_ns (N >= 2, evenly spaced) and their true biases; without rng: no errors. delay_s: to their arrival.

    spec.samples says whether a sample is instantaneous or the mean over the interval that ends at its stamp.
    White noise has the datasheet's density at any rate; a bias is a turn-on constant plus a Gauss-Markov process.
    """
    rate_hz = 1e9 / float(np.median(np.diff(t_ns)))
    config = ImuSimulation(rate_hz=rate_hz, errors=rng is not None, delay_s=delay_s)
    duration_s = (int(t_ns[-1]) - truth.start_ns) * 1e-9
    return ImuSensor(truth, None, duration_s, spec, config, rng or np.random.default_rng(0)).sense(t_ns)


def _temperature(count: int, step_s: float, config: Temperature, rng: Rng) -> Floats:
    """(count,) K above that at power-up."""
    wander = GaussMarkov(rng, 1, step_s, config.wander_time_s).rows(count)[:, 0]
    warm = 1.0 - np.exp(-np.arange(count) * (step_s / config.rise_time_s))
    result: Floats = config.rise_k * warm + config.wander_k * (wander - wander[0])
    return result


def _triads(
    spec: ImuSpec, flaws: ImuFlaws, temperature: Floats, step_s: float, interval_s: float, rng: Rng
) -> tuple[_Triad, _Triad]:
    """Errors of gyro and accelerometer."""
    ppm = 1e-6

    def triad(
        turn_on: float, drift: float, density: float, scale: float, bias_k: float, scale_k: float, rest: float
    ) -> _Triad:
        wander = GaussMarkov(rng, 3, step_s, spec.bias_time_constant_s).rows(len(temperature))
        constant, warm_bias, constant_scale, warm_scale = rng.standard_normal((4, 3))
        skew = np.radians(flaws.misalignment_deg) * rng.standard_normal((3, 3))
        np.fill_diagonal(skew, 0.0)
        bias = turn_on * constant + drift * wander + bias_k * warm_bias * temperature[:, None]
        gain = 1.0 + scale * ppm * constant_scale + scale_k * ppm * warm_scale * temperature[:, None]
        return _Triad(bias, gain, np.eye(3) + skew, rest, density / np.sqrt(interval_s))

    gyro = triad(
        spec.gyro_turn_on_bias_deg_per_h * DEG_PER_H,
        spec.gyro_bias_instability_deg_per_h * DEG_PER_H,
        spec.gyro_noise_deg_per_sqrt_h * np.pi / 180 / 60,
        flaws.gyro_scale_ppm,
        flaws.gyro_bias_deg_per_h_per_k * DEG_PER_H,
        flaws.gyro_scale_ppm_per_k,
        0.0,
    )
    accel = triad(
        spec.accel_turn_on_bias_mg * MILLI_G,
        spec.accel_bias_instability_mg * MILLI_G,
        spec.accel_noise_m_per_s_per_sqrt_h / 60,
        flaws.accel_scale_ppm,
        flaws.accel_bias_mg_per_k * MILLI_G,
        flaws.accel_scale_ppm_per_k,
        STANDARD_GRAVITY,
    )
    return gyro, accel


def _speed(course: Course, t_ns: NDArray[np.int64]) -> Floats:
    """(N,) m/s at t_ns (N,), by differences over the course."""
    known = seconds(course.t_ns, course.t_ns[0])
    speed: Floats = np.interp(seconds(t_ns, course.t_ns[0]), known, np.gradient(course.s, known))
    return speed
