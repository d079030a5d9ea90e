"""egoloc allan: presets come back from simulated rest, real rests against what their logs say, files and bad input."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from replay.allan import UNITS, Analysis, analyse
from replay.cli import main
from replay.config import RunConfig, load_config
from replay.sources import LogSource, McapSource, ScenarioSource
from sensors.datasets import load as load_dataset
from sensors.errors import EgolocError
from sensors.mcap.io import write_log
from sensors.records import Imu, Log
from sensors.simulate.drive import simulate
from sensors.simulate.imu import ImuSimulation
from sensors.simulate.imu_presets import PRESETS, PresetName
from sensors.simulate.scenarios import Scenario, load
from sensors.vehicle import ImuSpec

FOUND = (
    "gyro_noise_deg_per_sqrt_h",
    "accel_noise_m_per_s_per_sqrt_h",
    "gyro_bias_instability_deg_per_h",
    "accel_bias_instability_mg",
)


def resting(hours: float, preset: PresetName = "tactical", hz: float = 20.0, seed: int = 4) -> Scenario:
    """The scenario at rest with an IMU of a kind, at a low rate: densities do not follow it."""
    return msgspec.structs.replace(
        load("static"), imu=ImuSimulation(rate_hz=hz, preset=preset), duration_s=3600.0 * hours, seed=seed
    )


@pytest.mark.parametrize("preset", list(PRESETS))
def test_a_preset_comes_back_from_six_hours_at_rest(preset: PresetName) -> None:
    """White noise within 2 %; of the drift the driving noise sigma sqrt(2 / T), which is all that the filter uses,
    within three of its errors, which are below 10 %."""
    given = PRESETS[preset].spec
    analysis = analyse(ScenarioSource(resting(6.0, preset)), RunConfig())
    spec = analysis.vehicle.imu
    for field in FOUND[:2]:
        assert getattr(spec, field) == pytest.approx(getattr(given, field), rel=0.02), field
    for sensor, field in zip(("gyro", "accel"), FOUND[2:], strict=True):
        noise = analysis.noise[sensor]["all"]
        expected = getattr(given, field) * np.sqrt(2.0 / given.bias_time_constant_s) / UNITS[sensor].drift_scale
        assert abs(noise.drift_rate - expected) < 3.0 * noise.drift_rate_error, sensor
        assert noise.drift_rate_error < 0.1 * expected, sensor
        written = getattr(spec, field) * np.sqrt(2.0 / spec.bias_time_constant_s) / UNITS[sensor].drift_scale
        assert written == pytest.approx(noise.drift_rate, rel=1e-3), sensor
    assert analysis.facts["rest"]["whole"]
    assert analysis.facts["warnings"] == []


@pytest.mark.slow
def test_three_days_at_rest_show_time_constants() -> None:
    """A drift's sigma and time constant by themselves take long: within 10 and 25 % after 260 time constants."""
    analysis = analyse(ScenarioSource(resting(72.0, hz=10.0)), RunConfig())
    given = PRESETS["tactical"].spec
    for sensor, field in zip(("gyro", "accel"), FOUND[2:], strict=True):
        noise = analysis.noise[sensor]["all"]
        assert noise.drift_time_s == pytest.approx(given.bias_time_constant_s, rel=0.25)
        assert noise.drift_sigma * UNITS[sensor].drift_scale == pytest.approx(getattr(given, field), rel=0.1)


def run(*arguments: str | Path) -> int:
    return main(["allan", *map(str, arguments)])


def test_it_prints_and_writes_a_picture_figures_and_the_table_to_paste(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, log = tmp_path / "found", tmp_path / "rest.mcap"
    write_log(log, [simulate(900.0, 1, resting(1.0))])
    assert run(log, "--out", out) == 0
    printed = capsys.readouterr().out
    assert "At rest from 1.0 to 899.0 s of 900.0 s: 898.0 s, 20.00 Hz" in printed
    assert "Note: 898 s are short for drifts: bias figures are rough, hours are better." in printed
    assert (out / "vehicle.toml").read_text() in printed
    assert (out / "allan.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "allan.png").stat().st_size > 20_000
    found = json.loads((out / "allan.json").read_text())
    config = load_config(out / "vehicle.toml")
    assert config.vehicle is not None
    assert msgspec.to_builtins(config.vehicle.imu) == found["vehicle_imu"]
    assert config.vehicle.gnss_lever_arm == (0.5, 0.0, 1.2)
    assert found["gyro"]["x"]["random_walk_deg_per_sqrt_h"] == pytest.approx(0.1, rel=0.02)
    assert found["accel"]["z"]["random_walk_m_per_s_per_sqrt_h"] == pytest.approx(0.05, rel=0.02)
    assert len(found["curve"]["gyro"]["tau_s"]) == len(found["curve"]["gyro"]["x"]) == 12
    # the same again, into the same folder, as JSON
    assert run(log, "--out", out, "--json") == 0
    assert json.loads(capsys.readouterr().out) == found


def test_what_a_short_rest_shows_and_what_it_does_not() -> None:
    analysis = analyse(ScenarioSource(resting(0.05)), RunConfig())
    spec, given = analysis.vehicle.imu, ImuSpec()
    assert spec.gyro_noise_deg_per_sqrt_h == pytest.approx(0.1, rel=0.05)
    assert spec.gyro_bias_instability_deg_per_h == given.gyro_bias_instability_deg_per_h
    assert spec.bias_time_constant_s == given.bias_time_constant_s
    assert analysis.facts["gyro"]["all"]["drift_time_s"] is None
    assert not analysis.facts["gyro"]["all"]["bias_instability_reached"]
    warnings = " ".join(analysis.facts["warnings"])
    assert "178 s are too short for drifts" in warnings
    assert "accel_bias_instability_mg is the given one, not measured" in warnings


def test_of_a_drive_its_longest_stop_counts_and_it_says_so() -> None:
    scenario = load("clean")
    driver = msgspec.structs.replace(scenario.driver, rest_s=25.0)
    drive = msgspec.structs.replace(scenario, duration_s=60.0, driver=driver)
    analysis = analyse(ScenarioSource(drive), RunConfig())
    rest = analysis.facts["rest"]
    assert rest["from_s"] == pytest.approx(1.0)
    assert rest["to_s"] == pytest.approx(25.0, abs=3.0)
    assert "the vehicle moves" in analysis.facts["warnings"][0]


def test_a_window_bounds_where_rest_is_looked_for() -> None:
    source = ScenarioSource(resting(0.1))
    rest = analyse(source, RunConfig(), 100.0, 200.0).facts["rest"]
    assert (rest["from_s"], rest["to_s"]) == (pytest.approx(101.0), pytest.approx(199.0, abs=1.0))
    with pytest.raises(EgolocError, match=r"--from, --to: expected times within the log's 360.0 s, got 500.0, None"):
        analyse(source, RunConfig(), 500.0)


def moving(log: Log) -> Log:
    assert log.imu is not None
    shake = 0.1 * np.sin(np.arange(len(log.imu)))[:, None]
    return replace(log, imu=replace(log.imu, gyro=log.imu.gyro + shake))


def jittered(log: Log) -> Log:
    assert log.imu is not None
    late = log.imu.t_ns + np.random.default_rng(1).integers(0, 40_000_000, len(log.imu))
    return replace(log, imu=Imu(late, late, log.imu.gyro, log.imu.accel))


def stuck(log: Log) -> Log:
    assert log.imu is not None
    zero, up = np.zeros_like(log.imu.gyro), np.tile((0.0, 0.0, 9.81), (len(log.imu), 1))
    return replace(log, imu=replace(log.imu, gyro=zero, accel=up))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (moving, "expected the vehicle at rest for 12 s on end, got 0 s at most"),
        (jittered, "expected IMU samples at an even rate"),
        (stuck, "got samples that do not change"),
        (lambda log: Log(gnss=log.gnss), "the log has no IMU samples"),
    ],
)
def test_bad_logs_end_in_one_line(
    spoil: Callable[[Log], Log], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log.mcap"
    write_log(log, [spoil(simulate(60.0, 1, resting(1.0)))])
    assert run(log, "--out", tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert error.startswith(f"egoloc: error: {log}: ")
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_folder_with_other_files_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert run("scenario:static,duration_s=60", "--out", tmp_path) == 2
    assert "expected a new folder or one of an earlier analysis, got one with mine.txt" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
    assert run("scenario:static,drives=2", "--out", tmp_path / "x") == 2
    assert "expected one drive, got 2" in capsys.readouterr().err


def real(data: Path, name: str, format: str, tmp_path: Path) -> Analysis:
    log = tmp_path / "log.mcap"
    write_log(log, [load_dataset(format, data / name)])
    source: LogSource = McapSource(log)
    return analyse(source, RunConfig())


def test_rtk_drive_idles_much_louder_than_its_part(data: Path, tmp_path: Path) -> None:
    """32 s with the engine on. TDK's sheet of the ICM-45686 says 3.8 mdps and 70 ug per sqrt(Hz), which are 0.23
    deg/sqrt(h) and 0.041 m/s/sqrt(h); shaken by the engine it is three to ten times that, roll and pitch most."""
    analysis = real(data, "rtk_drive", "rtklib", tmp_path)
    walk = {axis: analysis.facts["gyro"][axis]["random_walk_deg_per_sqrt_h"] for axis in "xyz"}
    assert 28.0 < analysis.facts["rest"]["length_s"] < 40.0
    assert walk["z"] == pytest.approx(0.67, rel=0.1)
    assert 1.8 < walk["x"] < 2.5
    assert 1.5 < walk["y"] < 2.6
    assert 0.3 < analysis.vehicle.imu.accel_noise_m_per_s_per_sqrt_h < 0.8
    assert any("too short for drifts" in warning for warning in analysis.facts["warnings"])


@pytest.mark.parametrize(
    "drive",
    [
        "parking-lot-figure8-nominal-001",
        pytest.param("mixed-road-long-drive-nominal-001", marks=pytest.mark.slow),
    ],
)
def test_phones_are_quieter_than_the_sheet_that_the_importer_assumes(data: Path, drive: str, tmp_path: Path) -> None:
    """Engine off or far: 0.11 to 0.16 deg/sqrt(h), where the importer's class says 0.42, on all axes alike."""
    analysis = real(data, f"imu_gnss_drives/{drive}", "imu-gnss-drive", tmp_path)
    for axis in "xyz":
        assert 0.09 < analysis.facts["gyro"][axis]["random_walk_deg_per_sqrt_h"] < 0.2
        assert 0.02 < analysis.facts["accel"][axis]["random_walk_m_per_s_per_sqrt_h"] < 0.09


def test_a_drive_that_never_rests_is_refused(data: Path, tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="at rest for 12 s on end"):
        real(data, "comma2k19", "comma2k19", tmp_path)
