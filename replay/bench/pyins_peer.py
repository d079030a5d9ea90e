"""pyins (on PyPI: python-ins): its feedback filter, strapdown on WGS-84 in numba and filter in pandas."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from replay.bench.peers import EVERY, SIGMA, PeerDrive
from sensors.geodesy import enu_from_llh, llh_from_enu

Floats = NDArray[np.float64]

FRD = np.array([1.0, -1.0, -1.0])
"""Body axes of pyins are forward-right-down."""
DEG = np.degrees(1.0)


def track(drive: PeerDrive, steps: int) -> Floats:
    """(steps / EVERY, 3) ENU positions after each fix, m.

    ``filters.run_feedback_filter`` with 15 states, its covariance propagated from fix to fix (a longer time step is cut
    there), GNSS as its ``Position`` with the lever arm. pyins has no measurement of a heading; the pose fix is a
    ``Measurement`` of our own, as its documentation proposes: north, east and heading with the full covariance. No
    gates.
    """
    from pyins import filters, inertial_sensor, measurements, strapdown, transform, util

    n = steps // EVERY + 1
    t = np.arange(steps + 1, dtype=np.float64) * drive.dt
    t_fix = t[::EVERY]
    imu = _frame(
        np.hstack((drive.gyro[: steps + 1] * FRD, drive.accel[: steps + 1] * FRD)), t, util.GYRO_COLS, util.ACCEL_COLS
    )
    antenna = _degrees(llh_from_enu(drive.antenna[:n], drive.datum))
    sigma = float(np.sqrt(np.trace(drive.antenna_cov) / 3.0))
    position = measurements.Position(_frame(antenna, t_fix, util.LLA_COLS), sigma, drive.arm * FRD)
    start = _frame(np.zeros((1, 9)), t[:1], util.TRAJECTORY_COLS).iloc[0]
    start["heading"] = 90.0 - DEG * drive.pose[0, 2]
    arm_ned = transform.mat_from_rph(start[util.RPH_COLS]) @ (drive.arm * FRD)
    start[util.LLA_COLS] = transform.perturb_lla(antenna[0], -arm_ned)
    gyro_walk, accel_walk = drive.bias_walk()
    result = filters.run_feedback_filter(
        start,
        SIGMA["position"],
        SIGMA["velocity"],
        DEG * SIGMA["tilt"],
        DEG * SIGMA["yaw"],
        strapdown.compute_increments_from_imu(imu, "rate"),
        inertial_sensor.EstimationModel(SIGMA["gyro bias"], drive.noise.gyro_psd**0.5, gyro_walk**0.5),
        inertial_sensor.EstimationModel(SIGMA["accel bias"], drive.noise.accel_psd**0.5, accel_walk**0.5),
        [position, _pose_fixes(drive, n, t_fix)],
        time_step=1.0,
    )
    lla = result.trajectory[util.LLA_COLS].to_numpy()[EVERY::EVERY]
    return enu_from_llh(lla / (DEG, DEG, 1.0), drive.datum)


def _pose_fixes(drive: PeerDrive, n: int, t: Floats) -> Any:
    """The first n pose fixes, at times t (n,), as a Measurement of north m, east m, heading deg."""
    from pyins import measurements, transform, util

    level = np.column_stack((drive.pose[:n, :2], drive.antenna[:n, 2]))
    lla = _degrees(llh_from_enu(level, drive.datum))
    T = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -DEG]])  # from east, north, yaw
    cov = T @ drive.pose_cov[:n] @ T.T
    heading = 90.0 - DEG * drive.pose[:n, 2]

    class PoseFix(measurements.Measurement):  # type: ignore[misc]
        def compute_matrices(self, time: float, pva: Any, error_model: Any) -> tuple[Floats, Floats, Floats] | None:
            row = rows.get(time)
            if row is None:
                return None
            place, (_, pitch, yaw) = pva[util.LLA_COLS].to_numpy(), pva[util.RPH_COLS].to_numpy()
            ned = transform.compute_lla_difference(place, [lla[row, 0], lla[row, 1], place[2]])
            z = np.array([ned[0], ned[1], (yaw - heading[row] + 180.0) % 360.0 - 180.0])
            H = np.zeros((3, 9))
            H[0, error_model.DR1] = H[1, error_model.DR2] = 1.0
            slope = np.tan(pitch / DEG)
            H[2, error_model.PHI] = -DEG * np.array([np.cos(yaw / DEG) * slope, np.sin(yaw / DEG) * slope, 1.0])
            return z, H, cov[row]

    rows = {time: row for row, time in enumerate(t.tolist())}
    return PoseFix(_frame(np.column_stack((lla[:, :2], heading)), t, ["lat", "lon", "heading"]))


def _frame(values: Floats, t: Floats, *columns: list[str]) -> Any:
    """A table over time t, s."""
    from pandas import DataFrame

    return DataFrame(values, index=t, columns=[name for group in columns for name in group])


def _degrees(llh: Floats) -> Floats:
    """(N, 3) deg, deg, m."""
    return llh * (DEG, DEG, 1.0)
