"""What a filter needs to know of a vehicle: where its sensors sit and how good its IMU is."""

from typing import Literal

import msgspec

from sensors.bounds import Delay, Lever, NonNegative, Positive

Vector3 = tuple[Lever, Lever, Lever]


class ImuSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Datasheet figures of an IMU. Default: the Epson G320N of the NovAtel PwrPak7D-E1 (the paper's unit)."""

    name: str = "epson-g320n"
    samples: Literal["rate", "increment"] = "rate"
    """rate: instantaneous at the stamp; increment: mean over the interval that ends at the stamp."""
    gyro_noise_deg_per_sqrt_h: NonNegative = 0.1
    """Angle random walk, deg/sqrt(h)."""
    accel_noise_m_per_s_per_sqrt_h: NonNegative = 0.05
    """Velocity random walk, m/s/sqrt(h)."""
    gyro_bias_instability_deg_per_h: NonNegative = 3.5
    """Standard deviation of the drifting gyro bias (first-order Gauss-Markov), deg/h."""
    accel_bias_instability_mg: NonNegative = 0.1
    """Standard deviation of the drifting accelerometer bias (first-order Gauss-Markov), milli-g."""
    gyro_scale_ppm: NonNegative = 0.0
    """Standard deviation of the gyro's scale error about the vertical axis: a state; 0: none, ppm."""
    gyro_misalignment_deg: NonNegative = 0.0
    """Standard deviation of how far its other axes see the yaw rate, deg."""
    accel_scale_ppm: NonNegative = 0.0
    """Standard deviation of the accelerometer's scale error, ppm."""
    accel_misalignment_deg: NonNegative = 0.0
    """Standard deviation of how far its axes see the acceleration along the others, deg."""
    gyro_bias_deg_per_h_per_k: NonNegative = 0.0
    """How the gyro bias changes with temperature (standard deviation), deg/h/K."""
    accel_bias_mg_per_k: NonNegative = 0.0
    """The same of the accelerometer bias, milli-g/K."""
    bias_time_constant_s: Positive = 1000.0
    """Correlation time of both drifting biases, s."""
    gyro_turn_on_bias_deg_per_h: NonNegative = 360.0
    """Standard deviation of the constant gyro bias at power-on, deg/h."""
    accel_turn_on_bias_mg: NonNegative = 5.0
    """Standard deviation of the constant accelerometer bias at power-on, milli-g."""


class Vehicle(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Extrinsics in the body frame (FLU, origin at the IMU) and the IMU's datasheet.

    Records hold IMU samples already rotated into body axes, so the IMU needs no rotation here.
    """

    imu: ImuSpec = ImuSpec()
    gnss_lever_arm: Vector3 = (0.0, 0.0, 0.0)
    """Main GNSS antenna, m, body frame."""
    gnss_lever_arm_sigma_m: NonNegative = 0.0
    """How well the antenna's place is known (each axis), m."""
    pose_lever_arm: Vector3 = (0.0, 0.0, 0.0)
    """Point whose pose EgoVM reports, m, body frame."""
    rear_axle: Vector3 = (0.0, 0.0, 0.0)
    """Point that moves along the vehicle's axis (non-holonomic constraint, wheel speed), m, body frame."""
    reference_lever_arm: Vector3 = (0.0, 0.0, 0.0)
    """Point whose trajectory the reference gives, m, body frame."""
    gnss_delay_s: Delay = 0.0
    """GNSS positions are true this long before their stamp, s (negative: after it)."""
    gnss_velocity_delay_s: Delay = 0.0
    """GNSS velocities are true this long before their stamp, s."""
    land_vehicle: bool = True
    """Wheels that do not slip sideways: zero-velocity and non-holonomic updates apply."""
