"""Configuration and measurements as the kernel reads them: SI units, and one sorted list of events.

Ordering lives here, outside the core: measurements are laid out by the time at which they were true.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from fusion.config import KERNELS, FusionConfig, check
from fusion.covariance import Noise
from fusion.divergence import HealthLimits
from fusion.events import MOTION, OUTPUT, Events, Parameters
from fusion.layout import OFF, Layout, layout_of
from fusion.sensor_models import ImuNoise
from fusion.sources import APPLY, Sources
from sensors._kernels import STANDARD_GRAVITY
from sensors.vehicle import ImuSpec, Vehicle

_ROOT_HOUR = 60.0
_DEG_PER_H = math.pi / 180.0 / 3600.0
_MILLI_G = 1e-3 * STANDARD_GRAVITY
_CHANGE = 5.0
"""So much of a change of velocity is not taken back by the next one, m/s: of a share e of it, which the accelerometer
misses, the variance is e^2 times its square; as a walk along the change that is this times e^2 for each m/s."""


def noise_of(spec: ImuSpec, model: ImuNoise, wheel_scale_walk: float = 0.0) -> Noise:
    """Process noise per second from datasheet units. wheel_scale_walk: 1/sqrt(h)."""
    gyro = math.radians(spec.gyro_noise_deg_per_sqrt_h) / _ROOT_HOUR * model.noise_scale
    accel = spec.accel_noise_m_per_s_per_sqrt_h / _ROOT_HOUR * model.noise_scale
    gyro_bias_var = (spec.gyro_bias_instability_deg_per_h * _DEG_PER_H) ** 2
    accel_bias_var = (spec.accel_bias_instability_mg * _MILLI_G) ** 2
    gyro_warmth = spec.gyro_bias_deg_per_h_per_k * _DEG_PER_H * model.temperature_walk_k
    accel_warmth = spec.accel_bias_mg_per_k * _MILLI_G * model.temperature_walk_k
    accel_share_var = (1e-6 * spec.accel_scale_ppm) ** 2 + math.radians(spec.accel_misalignment_deg) ** 2
    decay = 2.0 / spec.bias_time_constant_s
    return Noise(
        gyro_psd=gyro**2,
        accel_psd=accel**2,
        gyro_bias_var=gyro_bias_var,
        gyro_bias_rate=gyro_bias_var * decay + gyro_warmth**2,
        accel_bias_rate=accel_bias_var * decay + accel_warmth**2,
        wheel_scale_rate=wheel_scale_walk**2 / 3600.0,
        velocity_per_change=accel_share_var * _CHANGE,
    )


def parameters(vehicle: Vehicle, config: FusionConfig) -> Parameters:
    """The configuration in SI units."""
    gates, motion, pose = config.gates, config.motion, config.pose
    check(config)
    never = (math.inf, math.inf, math.inf)
    inflation = math.sqrt(pose.inflation)
    layout = layout_of(vehicle, config)
    noise = noise_of(vehicle.imu, config.imu, motion.wheel_scale_walk if motion.wheel else 0.0)
    noise = noise._replace(gyro_scale=layout.gyro_scale, gyro_misalignment=layout.gyro_misalignment)
    return Parameters(
        noise=noise,
        layout=layout,
        axes_var=math.radians(vehicle.imu.gyro_misalignment_deg) ** 2 if layout.gyro_misalignment == OFF else 0.0,
        gnss_rate=1.0 / config.gnss.lasting_s,
        pose_per_m=1.0 / pose.lasting_m,
        gnss_shares=(config.gnss.white_share, config.gnss.lasting_share),
        pose_shares=(pose.white_share, pose.lasting_share),
        increments=vehicle.imu.samples == "increment",
        max_gap_ns=round(config.imu.max_gap_s * 1e9),
        bridge_ns=round(config.imu.max_bridge_s * 1e9),
        coast_accel=config.imu.coast_accel,
        coast_rate=float(np.radians(config.imu.coast_rate_deg)),
        gate=_thresholds(gates.probability) if gates.use else never,
        outvoted=gates.outvoted,
        streak=gates.streak,
        reentry=_thresholds(min(gates.reentry, gates.probability)) if gates.use else never,
        robust=KERNELS.index(gates.robust),
        robust_sigmas=gates.robust_sigmas,
        gnss_arm=_vector(vehicle.gnss_lever_arm),
        pose_arm=_vector(vehicle.pose_lever_arm),
        axle=_vector(vehicle.rear_axle),
        pose_limits=(
            inflation * pose.max_sigma_longitudinal_m,
            inflation * pose.max_sigma_lateral_m,
            float(np.radians(inflation * pose.max_sigma_yaw_deg)),
        ),
        pose_partial=pose.partial,
        zero_velocity=motion.zero_velocity and vehicle.land_vehicle,
        non_holonomic=motion.non_holonomic and vehicle.land_vehicle,
        wheel_slip=motion.wheel_slip,
        lateral_var=motion.lateral_sigma**2,
        vertical_var=motion.vertical_sigma**2,
        per_speed=motion.sigma_per_speed,
        learning_ticks=round(motion.learning_s * motion.rate_hz),
        unknown_var=motion.unknown_sigma**2,
        min_speed=motion.min_speed,
        still_window_ns=round(motion.still_window_s * 1e9),
        still_wait_ns=round(motion.still_wait_s * 1e9),
        still_ratio=motion.still_ratio,
        still_accel_var=motion.still_accel**2,
        still_rate_var=float(np.radians(motion.still_rate_deg) ** 2),
        still_drift_var=motion.still_drift**2,
        still_max_speed=motion.still_max_speed,
        zero_velocity_var=motion.zero_velocity_sigma**2,
        zero_rate_var=float(np.radians(motion.zero_rate_sigma_deg) ** 2) + noise.gyro_psd * motion.rate_hz,
        health=_health_limits(config, layout, land_vehicle=vehicle.land_vehicle),
        level=vehicle.land_vehicle,
    )


def _health_limits(config: FusionConfig, layout: Layout, *, land_vehicle: bool) -> HealthLimits:
    model = config.health
    first, second, third = (_chi_square(config.gates.probability, dof) for dof in (1, 2, 3))
    gnss, pose, wheel = (round(s * 1e9) for s in (model.gnss_stale_s, model.pose_stale_s, model.wheel_stale_s))
    return HealthLimits(
        explained=(first, second, third),
        stale_ns=(gnss, gnss, gnss, pose, wheel),
        suspect=model.suspect_count,
        dead_reckoning_ns=round(model.dead_reckoning_s * 1e9),
        recovered_ns=round(model.recovered_s * 1e9),
        sigma_var=model.max_sigma_m**2,
        sigma_yaw_var=float(np.radians(model.max_sigma_yaw_deg) ** 2),
        lost_ns=round(model.lost_s * 1e9),
        lost=model.lost_count,
        contradicted_ns=round(model.contradicted_s * 1e9),
        settled_ns=round(model.settled_s * 1e9),
        max_speed2=model.max_speed**2 if land_vehicle else np.inf,
        least_upright=float(np.cos(np.radians(model.max_tilt_deg))) if land_vehicle else -np.inf,
        blown_var=model.blown_sigma_m**2,
        blown_yaw_var=float(np.radians(model.blown_sigma_yaw_deg) ** 2),
        restart=model.restart,
        pause_ns=round(model.restart_pause_s * 1e9),
        alone_ns=round(model.alone_s * 1e9),
        wide_yaw_var=float(np.radians(model.wide_sigma_yaw_deg) ** 2),
        far_m=model.far_m,
        course_speed2=config.alignment.min_course_speed**2,
        lasting=(layout.gnss_error, layout.pose_error),
        lasting_sigmas=model.lasting_sigmas,
    )


def _thresholds(probability: float) -> tuple[float, float, float]:
    """For 1, 2 and 3 degrees of freedom."""
    return _chi_square(probability, 1), _chi_square(probability, 2), _chi_square(probability, 3)


def _chi_square(probability: float, dof: int) -> float:
    """The quantile of a chi-square distribution (scipy.stats has it as well, and takes most of a second to import)."""
    return 2.0 * float(gammaincinv(dof / 2.0, probability))


def _vector(given: tuple[float, float, float]) -> tuple[float, float, float]:
    return float(given[0]), float(given[1]), float(given[2])


def grid(first_ns: int, last_ns: int, period: int) -> NDArray[np.int64]:
    """Multiples of the period in [first, last], ns; of period 0 there are none."""
    if period == 0:
        return np.empty(0, np.int64)
    start = -(-first_ns // period)
    return np.arange(start, last_ns // period + 1, dtype=np.int64) * period


def periods(config: FusionConfig, land_vehicle: bool) -> tuple[int, int]:
    """Of outputs and of motion ticks, ns (0: there are none)."""
    motion = config.motion
    wanted = land_vehicle and (motion.zero_velocity or motion.non_holonomic)
    return round(1e9 / config.output_hz), round(1e9 / motion.rate_hz) if wanted else 0


class Timeline(NamedTuple):
    """Events in order, and for each its arrival and its row in the log's record (-1: none)."""

    events: Events
    arrival_ns: NDArray[np.int64]
    log_row: NDArray[np.int64]


def merge(found: Sources, first_ns: int, last_ns: int, config: FusionConfig, land_vehicle: bool) -> Timeline:
    """Measurements, all in [first, last], with motion ticks and outputs, sorted.

    At equal times sensors come in the order of ``Sensor``, then motion, then output.
    """
    outputs, ticks = (grid(first_ns, last_ns, period) for period in periods(config, land_vehicle))
    made = np.concatenate((np.full(len(ticks), MOTION, np.int8), np.full(len(outputs), OUTPUT, np.int8)))
    none = np.full(len(made), -1)
    t = np.concatenate((found.t_ns, ticks, outputs))
    kind = np.concatenate((found.kind, made))
    order = np.lexsort((kind, t))
    events = Events(
        t[order],
        kind[order],
        np.concatenate((found.row, none))[order],
        np.concatenate((found.verdict, np.full(len(made), APPLY, np.int8)))[order],
    )
    arrival = np.concatenate((found.arrival_ns, ticks, outputs))[order]
    return Timeline(events, arrival, np.concatenate((found.log_row, none))[order])
