"""The composed log: rates, reproducibility, independence of components, user mistakes, scenarios."""

import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from sensors.errors import EgolocError
from sensors.geodesy import ecef_from_llh, llh_from_map
from sensors.records import Log
from sensors.rotation import multiply
from sensors.simulate import scenarios
from sensors.simulate.drive import Drive, DriveConfig, simulate, simulate_drive
from sensors.simulate.gnss_config import GnssSimulation
from sensors.simulate.imu import ImuSimulation
from sensors.simulate.pose_fix_config import PoseFixSimulation
from sensors.simulate.reference import ReferenceSimulation
from sensors.simulate.wheel import WheelSimulation
from sensors.vehicle import Vehicle

COLUMNS = ("imu", "gnss", "gnss_velocity", "pose_fixes", "wheel", "reference")


def same(a: Log, b: Log, column: str) -> bool:
    one, other = getattr(a, column), getattr(b, column)
    return all(np.array_equal(getattr(one, f), getattr(other, f), equal_nan=True) for f in one.__dataclass_fields__)


def test_every_sensor_spans_the_drive_at_its_rate(drive: Drive) -> None:
    log = drive.log
    assert {len(log.imu), len(log.reference)} == {60_001}  # type: ignore[arg-type]
    assert len(log.wheel) == 30_001  # type: ignore[arg-type]
    assert len(log.pose_fixes) == 6_000  # type: ignore[arg-type]
    for name in COLUMNS:
        column = getattr(log, name)
        assert column.t_ns[0] - drive.truth.start_ns <= 30_000_000
        assert drive.truth.start_ns + 600 * 10**9 - column.t_ns[-1] < 10**10
        assert (column.arrival_ns >= column.t_ns).all()
    assert log.vehicle.gnss_lever_arm == (0.5, 0.0, 1.2)


def test_the_reference_is_the_truth(drive: Drive) -> None:
    reference, frame = drive.log.reference, drive.log.map_frame
    assert reference is not None
    assert frame is not None
    place = llh_from_map(frame, reference.p_map)
    exact = ecef_from_llh(drive.truth.at(reference.t_ns).llh)
    assert np.abs(ecef_from_llh(place) - exact).max() < 1e-6
    assert np.linalg.norm(reference.p_map[:, :2], axis=1).max() < 20_000
    turned = multiply(reference.q_map_body * [-1, -1, -1, 1], drive.truth.at(reference.t_ns).q_enu_body)
    convergence = 2 * np.abs(turned[:, 2])
    # Munich lies 2.575 deg east of UTM's central meridian: dlon sin(lat)
    assert np.degrees(convergence).mean() == pytest.approx(2.575 * np.sin(np.radians(48.137)), abs=0.02)


def test_the_same_seed_gives_the_same_log_and_another_does_not() -> None:
    one, again, other = simulate(30.0, 5), simulate(30.0, 5), simulate(30.0, 6)
    for name in COLUMNS:
        assert same(one, again, name), name
        assert not same(one, other, name), name


def test_one_sensors_config_does_not_change_anothers_noise() -> None:
    base = simulate(30.0, 5)
    changed = simulate(30.0, 5, DriveConfig(gnss=GnssSimulation(rate_hz=5.0), wheel=WheelSimulation(use=False)))
    assert changed.wheel is None
    assert all(same(base, changed, name) for name in ("imu", "pose_fixes", "reference"))


def test_sensors_can_be_left_out() -> None:
    config = DriveConfig(
        gnss=GnssSimulation(use=False),
        pose_fix=PoseFixSimulation(use=False),
        wheel=WheelSimulation(use=False),
        reference=ReferenceSimulation(use=False),
        imu=ImuSimulation(rate_hz=200.0, errors=False),
    )
    drive = simulate_drive(10.0, 0, config)
    log = drive.log
    assert log.gnss is log.gnss_velocity is log.pose_fixes is log.wheel is log.reference is None
    assert log.imu is not None
    np.testing.assert_array_equal(log.imu.gyro, drive.truth.inertial(log.imu.t_ns)[0])
    assert len(log.imu) == 2001


def test_a_wheel_reads_the_axle_with_noise_and_scale(drive: Drive) -> None:
    wheel = drive.log.wheel
    assert wheel is not None
    speed = np.linalg.norm(drive.truth.at(wheel.t_ns).vel_enu, axis=1)
    assert (wheel.speed[speed == 0] == 0).all()
    moving = speed > 3.0
    scale = np.sum(wheel.speed[moving] * speed[moving]) / np.sum(speed[moving] ** 2)
    assert 1e-4 < abs(scale - 1) < 0.012
    assert (wheel.speed[moving] - scale * speed[moving]).std() == pytest.approx(0.05, rel=0.03)
    np.testing.assert_allclose(wheel.sigma, np.hypot(0.05, 0.003 * speed), atol=1e-12)


def test_a_wheel_ahead_of_the_body_reads_its_own_forward_speed() -> None:
    quiet = WheelSimulation(sigma=1e-9, scale_sigma=0.0)
    base = simulate(120.0, 1, DriveConfig(wheel=quiet)).wheel
    drive = simulate_drive(120.0, 1, DriveConfig(wheel=quiet, vehicle=Vehicle(rear_axle=(0.0, 1.0, 0.0))))
    assert base is not None
    assert drive.log.wheel is not None
    turn = drive.truth.at(base.t_ns).rate_to_earth()[:, 2]
    np.testing.assert_allclose(drive.log.wheel.speed - base.speed, -turn, rtol=0, atol=1e-7)
    assert np.abs(turn).max() > 0.05


@pytest.mark.parametrize("duration_s", [0.0, -5.0, float("nan"), float("inf")])
def test_an_impossible_duration_is_refused(duration_s: float) -> None:
    with pytest.raises(EgolocError, match="duration: expected at least 1 s"):
        simulate(duration_s)


def test_a_negative_seed_is_refused() -> None:
    with pytest.raises(EgolocError, match="seed: expected 0 or more, got -1"):
        simulate(10.0, -1)


@pytest.mark.parametrize("name", ["demo", "clean"])
def test_embedded_scenarios_load_and_run(name: str) -> None:
    assert name in scenarios.names()
    scenario = scenarios.load(name)
    assert scenario.name == name
    assert scenario.duration_s == 600.0
    log = simulate(20.0, scenario.seed, scenario)
    assert log.gnss is not None


def test_demo_has_float_lost_and_blind_stretches_and_clean_has_none() -> None:
    logs = {name: simulate(s.duration_s, s.seed, s) for name in ("demo", "clean") for s in [scenarios.load(name)]}
    gnss, fixes = logs["demo"].gnss, logs["demo"].pose_fixes
    assert gnss is not None
    assert fixes is not None
    assert 0.8 < np.mean(gnss.status == 4) < 0.97
    assert np.diff(gnss.t_ns).max() > 2 * 10**9
    blind = np.linalg.eigvalsh(fixes.cov[:, :2, :2])[:, 1] > 0.25
    assert 0.02 < blind.mean() < 0.15
    gnss, fixes = logs["clean"].gnss, logs["clean"].pose_fixes
    assert gnss is not None
    assert fixes is not None
    assert len(gnss) == 6001
    assert (gnss.status == 4).all()
    assert np.linalg.eigvalsh(fixes.cov[:, :2, :2]).max() < 0.101**2


def test_a_users_scenario_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('name = "mine"\ndoc = "x"\n[start]\nlatitude_deg = 31.2\n[imu]\nrate_hz = 200\n')
    scenario = scenarios.load(path)
    assert (scenario.start.latitude_deg, scenario.imu.rate_hz, scenario.seed) == (31.2, 200.0, 0)
    assert scenario.gnss == GnssSimulation()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[gnss]\nrate = 5.0\n", "unknown field `rate` - at `$.gnss`"),
        ("[gnss]\nrate_hz = 0.0\n", "Expected `float` > 0.0 - at `$.gnss.rate_hz`"),
        ("[gnss]\nuse = 'yes'\n", "Expected `bool`, got `str` - at `$.gnss.use`"),
        ("[city]\nblock_min_m = 900.0\n", "block_min_m: expected at most block_max_m (350), got 900 - at `$.city`"),
        ("[pose_fix]\nblind_min_s = 90.0\n", "blind_min_s: expected at most blind_max_s (9), got 90 - at `$.pose_fix`"),
        ("[start]\nlatitude_deg = 91.0\n", "Expected `float` <= 84.0 - at `$.start.latitude_deg`"),
        ("seed = -1\n", "Expected `int` >= 0 - at `$.seed`"),
        ("[gnss\n", "line 1"),
    ],
)
def test_a_mistake_in_a_scenario_names_file_and_field(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "broken.toml"
    path.write_text(
        text if text == "[gnss\n" else f'name = "a"\ndoc = "b"\n{text}' if "[" in text else f'{text}name="a"\ndoc="b"'
    )
    with pytest.raises(EgolocError) as caught:
        scenarios.load(str(path))
    assert str(caught.value).startswith(f"{path}: ")
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_scenario_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="one of the scenarios clean, demo"):
        scenarios.load("dmeo")
    with pytest.raises(EgolocError, match="cannot read the scenario: No such file"):
        scenarios.load(tmp_path / "absent.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(EgolocError, match=r"binary\.toml: "):
        scenarios.load(tmp_path / "binary.toml")


def test_the_snippets_of_the_docs_run(tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs/simulation.md").read_text()
    snippets = re.findall(r"```(python|toml)\n(.*?)```", page, re.DOTALL)
    names: dict[str, Any] = {}
    exec(next(text for kind, text in snippets if kind == "python"), names)
    assert len(names["motion"].llh) == len(names["drive"].log.gnss)
    path, shown = tmp_path / "page.toml", {}
    for text in (text for kind, text in snippets if kind == "toml"):
        path.write_text(text)
        scenario = scenarios.load(path)
        if scenario.trajectory is not None:
            continue  # along real data: tests/replay/test_simulated_logs.py
        shown[scenario.name] = simulate(60.0, scenario.seed, scenario)
        assert shown[scenario.name].gnss is not None
    log = shown["float-only"]
    assert log.gnss is not None
    assert np.mean(log.gnss.status == 3) > 0.9
    assert log.vehicle.imu.samples == "increment"


def test_a_scenario_round_trips_through_toml(tmp_path: Path) -> None:
    import tomllib

    scenario = scenarios.load("demo")
    decoded = tomllib.loads("\n".join(_toml(msgspec.to_builtins(scenario))))
    assert msgspec.convert(decoded, scenarios.Scenario) == scenario


def _toml(tree: dict[str, object], prefix: str = "") -> list[str]:
    """Dotted key = value lines of nested builtins."""
    lines: list[str] = []
    for key, value in tree.items():
        if isinstance(value, dict):
            lines += _toml(value, f"{prefix}{key}.")
        elif value is not None:
            lines.append(f"{prefix}{key} = {msgspec.json.encode(value).decode()}")
    return lines
