"""Run configurations: complete round trips, and errors that say where and what."""

from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.config import FusionConfig
from fusion.sensor_models import GnssModel
from replay.config import HideGnss, Limits, RunConfig, load_config, load_vehicle, parse_hide_gnss, to_toml
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.vehicle import Vehicle

FULL = RunConfig(
    topics={"imu": "/imu/data", "gnss": 'quo"te\\ß'},
    vehicle=Vehicle(gnss_lever_arm=(0.5, -0.1, 1.2), gnss_delay_s=-0.125),
    map_frame=MapFrame("utm", (5e5, 1e-7, 0.0), 32),
    fusion=FusionConfig(output_hz=20.0, gnss=GnssModel(use=False)),
    limits=Limits(1.4, 0.57, 1.5),
    hide_gnss=HideGnss(60.0, 15.0),
    seed=7,
)


@pytest.mark.parametrize("config", [RunConfig(), FULL])
def test_a_written_config_reads_back(config: RunConfig, tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text(to_toml(config))
    assert load_config(path) == config


def test_a_written_config_is_complete() -> None:
    text = to_toml(RunConfig())
    for name in msgspec.structs.asdict(FusionConfig()):
        assert name in text
    assert "lasting_share = 0.7" in text


@given(st.dictionaries(st.text(max_size=8), st.text(max_size=8), max_size=3))
def test_any_text_survives(topics: dict[str, str]) -> None:
    import tomllib

    assert tomllib.loads(to_toml(RunConfig(topics=topics)))["topics"] == topics


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[fusion.gnss]\ninflaton = 3", r'fusion\.gnss: unknown key "inflaton"; did you mean "inflation"\?'),
        (
            "colour = 1",
            'unknown key "colour"; expected topics, vehicle, map_frame, fusion, limits, hide_gnss, smooth, inject, '
            "seed",
        ),
        ("[vehicle.imu]\nnoise = 1", r'vehicle\.imu: unknown key "noise"; expected name, samples'),
        ('[fusion.gnss]\nuse = "yes"', r"fusion\.gnss\.use: expected `bool`, got `str`"),
        ("[limits]\nlon_m = 0", r"limits\.lon_m: expected `float` > 0"),
        ('[vehicle.imu]\nsamples = "x"', r"vehicle\.imu\.samples: expected one of rate, increment, got 'x'"),
        ('limits = "motorway"', "limits: expected one of paper, highway, local-street, got 'motorway'"),
        ("[vehicle]\ngnss_lever_arm = [1.0, 2.0]", r"vehicle\.gnss_lever_arm: expected `array` of length 3"),
        ('[map_frame]\nkind = "utm"', "map_frame: .*zone: expected 1..60, got 0"),
        ("[hide_gnss]\nevery_s = 5\nlength_s = 15", "hide_gnss: expected 0 < LENGTH < EVERY, got 5:15"),
        ("seed =", "expected TOML: "),
    ],
)
def test_mistakes_name_file_key_and_what_was_expected(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(EgolocError, match=r"mine\.toml: .*" + message) as caught:
        load_config(path)
    assert "\n" not in str(caught.value).split("expected TOML")[0]


def test_profiles_and_vehicle_files(tmp_path: Path) -> None:
    (tmp_path / "car.toml").write_text("gnss_lever_arm = [1.0, 0.0, 0.5]")
    (tmp_path / "run.toml").write_text('limits = "highway"\nvehicle = "car.toml"')
    config = load_config(tmp_path / "run.toml")
    assert config.limits == Limits(1.40, 0.57, 1.5)
    assert config.vehicle == Vehicle(gnss_lever_arm=(1.0, 0.0, 0.5)) == load_vehicle(tmp_path / "car.toml")


@pytest.mark.parametrize("text", ["60", "60:", "a:b", "15:60", "60:0", "60:15:3", "-60:-15", "inf:5", "nan:5"])
def test_hide_gnss_must_be_two_numbers_in_order(text: str) -> None:
    with pytest.raises(EgolocError, match="--hide-gnss: expected"):
        parse_hide_gnss(text)


def test_hide_gnss() -> None:
    assert parse_hide_gnss("60:15") == HideGnss(60.0, 15.0)
