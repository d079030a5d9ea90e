"""KITTI sequence 00 of the gtsam wheel: axes, clock and pauses of the real files, and mistakes in small ones."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from sensors.datasets import gtsam_kitti, load
from sensors.datasets.clock_offset import estimate_clock_offset
from sensors.datasets.inertial_fit import fit_window, moving_windows, strapdown
from sensors.errors import EgolocError
from sensors.geodesy import map_from_llh
from sensors.records import GnssStatus, GnssVelocity, Log, positive_definite

from .conftest import forward_correlation, yaw_rate_correlation

Floats = NDArray[np.float64]
PARTS_S = {"first": (0.0, 198.7), "middle": (200.3, 309.3), "last": (309.4, 471.0)}


@pytest.fixture(scope="module")
def folder() -> Path:
    """gtsam/Data, found without importing gtsam."""
    found = find_spec("gtsam")
    if found is None or not found.submodule_search_locations:
        pytest.skip("gtsam is not installed: pip install 'egoloc[bench]'")
    return Path(found.submodule_search_locations[0]) / "Data"


@pytest.fixture(scope="module")
def kitti(folder: Path) -> Log:
    return load("gtsam-kitti", folder)


def track(log: Log) -> tuple[Floats, Floats, GnssVelocity]:
    """Positions (N, 3) in the map, speed (N,) and the velocity of a spline through the positions."""
    assert log.gnss is not None
    assert log.map_frame is not None
    p = map_from_llh(log.map_frame, log.gnss.llh)
    t_ns = log.gnss.t_ns
    velocity = CubicSpline((t_ns - t_ns[0]) * 1e-9, p).derivative()((t_ns - t_ns[0]) * 1e-9)
    cov = np.tile(np.eye(3), (len(p), 1, 1))
    return p, np.hypot(*velocity[:, :2].T), GnssVelocity(t_ns, t_ns, velocity, cov)


def part(log: Log, name: str) -> Log:
    """A part of the drive by its name."""
    assert log.imu is not None
    assert log.gnss is not None
    begin, end = (log.imu.t_ns[0] + round(s * 1e9) for s in PARTS_S[name])
    imu, gnss = log.imu, log.gnss
    return replace(
        log,
        imu=imu[(imu.t_ns >= begin) & (imu.t_ns < end)],
        gnss=gnss[(gnss.t_ns >= begin) & (gnss.t_ns < end)],
    )


def test_everything_is_read(kitti: Log) -> None:
    assert kitti.imu is not None
    assert kitti.gnss is not None
    assert kitti.map_frame == gtsam_kitti.FRAME
    assert len(kitti.imu) == 46_968 - 1_257
    assert len(kitti.gnss) == 470
    assert [(x.reason, x.count) for x in kitti.left_out] == [("filled in along a straight line", 1_257)]
    assert kitti.imu.t_ns[0] == gtsam_kitti.ORIGIN_NS + 46_534_478_375_790
    p, _, _ = track(kitti)
    assert p[0] == pytest.approx([-6.8269361, -11.8681642, 0.0403061], abs=1e-6)
    assert (kitti.gnss.status == GnssStatus.FIXED).all()
    assert positive_definite(kitti.gnss.cov_enu).all()


def test_axes_are_forward_left_up(kitti: Log) -> None:
    assert kitti.imu is not None
    _, _, velocity = track(kitti)
    up = kitti.imu.accel.mean(axis=0)
    assert np.degrees(np.arccos(up[2] / np.linalg.norm(up))) < 2.0
    assert np.linalg.norm(up) == pytest.approx(9.8, abs=0.05)
    assert yaw_rate_correlation(kitti.imu, velocity, gtsam_kitti.DELAY_S, 3.0) > 0.98
    assert forward_correlation(kitti.imu, velocity, gtsam_kitti.DELAY_S) > 0.98


@pytest.mark.parametrize("name", PARTS_S)
def test_positions_are_late_by_the_same_in_every_part(kitti: Log, name: str) -> None:
    """Strapdown windows fit to centimetres throughout once the rows that were filled in are gone."""
    log = part(kitti, name)
    assert log.imu is not None
    assert log.gnss is not None
    p, speed, _ = track(log)
    sigma = np.tile(gtsam_kitti.SIGMA_ENU, (len(p), 1))
    windows = moving_windows(log.gnss.t_ns, speed, 8.0, 1.0)
    found = estimate_clock_offset(strapdown(log.imu), log.gnss.t_ns, p, sigma, windows, "position", 0.2)
    assert found.delay_s == pytest.approx(gtsam_kitti.DELAY_S, abs=0.01)
    assert found.sigma_s < 0.01
    assert found.rms < 0.03


def test_rows_that_were_filled_in_do_not_fit(kitti: Log, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With them, a window across such a pause in a turn leaves a decimetre; the filter's IMU then has a gap instead."""
    monkeypatch.setattr(gtsam_kitti, "LINEAR", -1.0)
    whole = load("gtsam-kitti", folder)
    assert whole.imu is not None
    assert kitti.imu is not None
    assert len(whole.imu) == 46_968
    p, _, _ = track(whole)
    assert whole.gnss is not None
    since_s = (whole.gnss.t_ns - whole.imu.t_ns[0]) * 1e-9
    rows = np.flatnonzero((since_s > 276.0) & (since_s < 285.0))
    sigma = np.tile(gtsam_kitti.SIGMA_ENU, (len(p), 1))
    fit = fit_window(strapdown(whole.imu), whole.gnss.t_ns, p, sigma, rows, gtsam_kitti.DELAY_S, "position")
    assert fit is not None
    assert np.sqrt(np.mean(fit.residual**2)) > 0.08
    pauses = np.sort(np.diff(kitti.imu.t_ns) * 1e-9)
    assert np.count_nonzero(pauses > 0.5) == 9
    assert pauses[-9:-1] == pytest.approx([1.6] * 8, abs=0.1)
    assert pauses[-1] == pytest.approx(1.92, abs=0.01)  # between the first two rows


def test_imu_figures_are_those_of_the_metadata(kitti: Log) -> None:
    spec = kitti.vehicle.imu
    assert spec.gyro_noise_deg_per_sqrt_h == pytest.approx(np.degrees(0.000175) * 60)
    assert spec.accel_noise_m_per_s_per_sqrt_h == pytest.approx(0.6)
    grown = spec.gyro_bias_instability_deg_per_h * np.sqrt(2.0 / spec.bias_time_constant_s)  # in a second
    assert np.radians(grown / 3600) == pytest.approx(2.91e-6 * np.sqrt(1 / 0.0100395), rel=1e-4)


IMU = "Time dt accelX accelY accelZ omegaX omegaY omegaZ"
METADATA = (
    "BodyPtx BodyPty BodyPtz BodyPrx BodyPry BodyPrz AccelerometerSigma GyroscopeSigma "
    "IntegrationSigma AccelerometerBiasSigma GyroscopeBiasSigma AverageDeltaT"
)


def written(
    folder: Path,
    *,
    imu_header: str = IMU,
    imu_rows: tuple[str, ...] = (),
    metadata: str = "0 0 0 0 0 0 0.01 0.000175 0 0.000167 2.91e-6 0.01",
    gps_cell: str = "3.0",
) -> Path:
    rows = [f"{k * 0.01:.2f} 0.01 0 0 9.8 0 0 {0.1 * (k % 2)}" for k in range(300)]
    (folder / "KittiEquivBiasedImu.txt").write_text("\n".join([imu_header, *rows, *imu_rows]))
    (folder / "KittiEquivBiasedImu_metadata.txt").write_text(f"{METADATA}\n{metadata}\n")
    (folder / "KittiGps_converted.txt").write_text(f"Time,X,Y,Z\n0.0,1.0,2.0,3.0\n1.0,1.0,2.0,{gps_cell}\n")
    return folder


def test_unusable_rows_are_counted(tmp_path: Path) -> None:
    log = load("gtsam-kitti", written(tmp_path, imu_rows=("3.0 0.01 nan 0 9.8 0 0 0", "1.0 0.01 0 0 9.8 0 0 0")))
    assert log.imu is not None
    assert len(log.imu) == 300
    assert {(x.reason, x.count) for x in log.left_out} == {("not finite", 1), ("stamp goes back", 1)}


def test_mistakes_name_file_and_column(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match=r"KittiGps_converted.txt: line 3: column Z: expected a number, got 'x'"):
        load("gtsam-kitti", written(tmp_path, gps_cell="x"))
    with pytest.raises(EgolocError, match=r"KittiEquivBiasedImu.txt: column omegaZ: not there"):
        load("gtsam-kitti", written(tmp_path, imu_header=IMU.replace("omegaZ", "omega")))
    with pytest.raises(EgolocError, match=r"_metadata.txt: BodyPtx: expected one row of figures with the IMU at the"):
        load("gtsam-kitti", written(tmp_path, metadata="1 0 0 0 0 0 0.01 0.000175 0 0.000167 2.91e-6 0.01"))
    with pytest.raises(EgolocError, match=r"_metadata.txt: AverageDeltaT: expected seconds above 0, got 0"):
        load("gtsam-kitti", written(tmp_path, metadata="0 0 0 0 0 0 0.01 0.000175 0 0.000167 2.91e-6 0"))
    (written(tmp_path) / "KittiGps_converted.txt").unlink()
    with pytest.raises(EgolocError, match=r"KittiGps_converted.txt: no such file"):
        load("gtsam-kitti", tmp_path)
