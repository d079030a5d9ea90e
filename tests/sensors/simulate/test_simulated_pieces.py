"""A drive cut anywhere is the same drive; its tags and its length; what a scenario of a fleet has."""

import tracemalloc
from dataclasses import fields
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest

from sensors.errors import EgolocError
from sensors.pieces import SENSORS, join
from sensors.records import Log
from sensors.simulate import scenarios
from sensors.simulate.drive import DriveConfig, plan, simulate, simulate_pieces
from sensors.simulate.environment import Environment, Landmarks, Sky
from sensors.simulate.imu import ImuSimulation, Temperature, Vibration
from sensors.simulate.network import NetworkPlan
from sensors.simulate.scenes import ScenePlan

BUSY = DriveConfig(
    network=NetworkPlan(length_km=40.0),
    environments={
        "city": Environment(
            sky=Sky(multipath_per_hour=100.0, multipath_m=5.0, wrong_fix_per_hour=50.0, lost_per_hour=60.0),
            landmarks=Landmarks(degenerate_per_km=2.0, dash_alias_per_km=2.0, lane_alias_per_km=1.0),
        ),
        "tunnel": Environment(share=0.2, sky=Sky(blocked=True)),
    },
    scenes=ScenePlan(night=1.0, autonomous_drives=1.0, autonomous_share=0.5),
    imu=ImuSimulation(
        preset="automotive",
        temperature=Temperature(rise_k=10.0, wander_k=1.0),
        vibration=Vibration(accel_idle=0.05, accel_per_speed=0.02, accel_line=0.1, gyro_idle_deg=0.1),
    ),
    pose_fix=msgspec.convert(
        {
            "map_fraction": 0.3,
            "feature_fraction": 0.3,
            "dropped_fraction": 0.02,
            "burst_per_hour": 60.0,
            "gross_per_hour": 60.0,
            "night_factor": 1.2,
            "lateral_spread": 0.3,
        },
        type(DriveConfig().pose_fix),
    ),
    wheel=msgspec.convert({"drift_sigma": 0.002, "quantum": 0.0156, "slip_per_accel": 0.02}, type(DriveConfig().wheel)),
    reference=msgspec.convert({"rate_hz": 20.0, "start_s": 10.0}, type(DriveConfig().reference)),
)
"""Everything that a drive can meet, switched on."""


def same(one: Log, other: Log) -> bool:
    for name in SENSORS:
        a, b = getattr(one, name), getattr(other, name)
        if (a is None) != (b is None):
            return False
        if a is not None and not all(
            np.array_equal(getattr(a, f.name), getattr(b, f.name), equal_nan=f.name != "text") for f in fields(a)
        ):
            return False
    return one.vehicle == other.vehicle and one.map_frame == other.map_frame


@pytest.mark.parametrize(
    "config", [DriveConfig(), BUSY, scenarios.load("road-test")], ids=["plain", "busy", "road-test"]
)
@pytest.mark.parametrize("piece_s", [7.31, 60.0, 300.0])
def test_a_drive_is_the_same_bit_for_bit_however_it_is_cut(config: DriveConfig, piece_s: float) -> None:
    whole = list(simulate_pieces(400.0, 3, config, piece_s=1e6))
    assert len(whole) == 1
    pieces = list(simulate_pieces(400.0, 3, config, piece_s=piece_s))
    assert len(pieces) == int(400.0 / piece_s) + 1
    assert same(join(pieces), whole[0])


def test_pieces_follow_each_other_and_hold_all_sensors_up_to_their_imu() -> None:
    pieces = list(simulate_pieces(200.0, 3, BUSY, piece_s=50.0))
    start_ns = BUSY.start.unix_s * 10**9
    for index, piece in enumerate(pieces):
        for name in SENSORS:
            record = getattr(piece, name)
            if record is not None:
                assert record.t_ns[0] >= start_ns + index * 50 * 10**9
                assert record.t_ns[-1] < start_ns + (index + 1) * 50 * 10**9
    for before, after in pairwise(pieces):
        assert before.imu is not None
        assert after.imu is not None
        assert after.imu.t_ns[0] - before.imu.t_ns[-1] == 10_000_000


def test_memory_does_not_follow_the_length() -> None:
    def peak(duration_s: float) -> int:
        tracemalloc.start()
        for _ in simulate_pieces(duration_s, 0, DriveConfig(), piece_s=60.0):
            pass
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    peak(60.0)
    short, long = peak(600.0), peak(6000.0)
    # what grows is the truth and the course: 2 rows a second
    assert long - short < 9 * 600 * 2_000
    assert long < 40e6


def test_tags_travel_in_the_log_where_there_are_environments() -> None:
    log = simulate(400.0, 3, BUSY)
    assert log.scene is not None
    assert log.mode is not None
    assert {str(text) for text in log.scene.text} <= {"city,night", "tunnel,night"}
    assert [str(text) for text in log.mode.text] == ["open-loop", "autonomous"]
    assert log.imu is not None
    assert log.scene.t_ns[0] == log.mode.t_ns[0] == log.imu.t_ns[0]
    plain = simulate(30.0, 3)
    assert plain.scene is plain.mode is None


def test_the_sky_of_the_tunnel_is_where_its_tag_says() -> None:
    log = simulate(1800.0, 4, BUSY)
    assert log.scene is not None
    assert log.gnss is not None
    row = np.searchsorted(log.scene.t_ns, log.gnss.t_ns, side="right") - 1
    in_tunnel = np.char.startswith(log.scene.text[row], "tunnel")
    assert np.char.startswith(log.scene.text, "tunnel").any()
    # a fix at the very edge may be on either side of it by rounding
    assert in_tunnel.sum() <= np.char.startswith(log.scene.text, "tunnel").sum()


def test_delays_of_gnss_stamps_are_refused() -> None:
    vehicle = {"vehicle": {"gnss_velocity_delay_s": 0.1}}
    with pytest.raises(
        (msgspec.ValidationError, EgolocError), match=r"vehicle\.gnss_velocity_delay_s: expected 0 .*0\.1"
    ):
        msgspec.convert(vehicle, DriveConfig)


def test_a_drive_ends_after_its_length_or_its_duration() -> None:
    config = msgspec.structs.replace(BUSY, length_km=2.0)
    planned = plan(None, 3, config)
    inside = planned.course.place(planned.truth.start_ns + np.array([0, round(planned.duration_s * 1e9)]))
    assert np.diff(inside)[0] == pytest.approx(2000.0, abs=1.0)
    assert plan(60.0, 3, config).duration_s == 60.0
    assert plan(None, 3, DriveConfig()).duration_s == 600.0


def test_the_reference_begins_after_power_up() -> None:
    log = simulate(60.0, 3, BUSY)
    assert log.reference is not None
    assert log.imu is not None
    assert log.reference.t_ns[0] - log.imu.t_ns[0] == 10 * 10**9
    assert np.diff(log.reference.t_ns).max() == 50_000_000


def test_drives_of_a_network_share_its_roads_and_differ_otherwise() -> None:
    one, again, other = (simulate(60.0, seed, BUSY) for seed in (3, 3, 4))
    assert same(one, again)
    assert not same(one, other)
    elsewhere = simulate(60.0, 3, msgspec.structs.replace(BUSY, network_seed=1))
    assert elsewhere.reference is not None
    assert one.reference is not None
    assert not np.array_equal(one.reference.p_map, elsewhere.reference.p_map)


def test_road_test_is_a_drive_of_30_km_with_every_fault() -> None:
    scenario = scenarios.load("road-test")
    assert (scenario.length_km, scenario.duration_s) == (30.0, None)
    assert scenario.network is not None
    assert scenario.network.length_km == 1000.0
    assert {"city", "canyon", "highway", "tunnel", "bridge", "underpass"} <= scenario.environments.keys()
    fixes = scenario.pose_fix
    assert fixes.map_fraction + fixes.feature_fraction >= 0.7
    log = simulate(120.0, 100_000, scenario)
    assert log.scene is not None
    assert log.vehicle.imu.name == "epson-g320n"


def test_network_and_trajectory_exclude_each_other() -> None:
    given = {"network": {}, "trajectory": {"file": "x.csv"}}
    with pytest.raises((msgspec.ValidationError, EgolocError), match=r"trajectory: expected no \[network\] beside it"):
        msgspec.convert(given, DriveConfig)


def test_a_scenario_along_a_trajectory_finds_the_file_beside_it(tmp_path: Path) -> None:
    known = simulate(60.0, 1, DriveConfig(map_frame="enu")).reference
    assert known is not None
    rows = np.column_stack((known.t_ns * 1e-9, known.p_map, known.q_map_body))[::10]
    np.savetxt(tmp_path / "way.tum", rows, fmt="%.9f")
    (tmp_path / "mine.toml").write_text('name = "mine"\ndoc = "x"\nmap_frame = "enu"\n[trajectory]\nfile = "way.tum"\n')
    scenario = scenarios.load(tmp_path / "mine.toml")
    log = simulate(scenario.duration_s, scenario.seed, scenario)
    assert log.reference is not None
    assert log.imu is not None
    assert (log.imu.t_ns[-1] - log.imu.t_ns[0]) * 1e-9 == pytest.approx(60.0, abs=1.1)
    again = np.array([np.interp(known.t_ns, log.reference.t_ns, column) for column in log.reference.p_map.T[:2]]).T
    inside = (known.t_ns > log.reference.t_ns[0]) & (known.t_ns < log.reference.t_ns[-1])
    offset = again - known.p_map[:, :2]
    assert np.abs(offset[inside] - offset[inside][0]).max() < 0.5
