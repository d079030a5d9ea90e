"""Logs that lack something, and results that must not pass for success, through the command line."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fusion.result import FusionResult
from fusion.run import Session
from replay.cli import main
from sensors.mcap.io import write_log
from sensors.records import Log
from tests.replay.spoiling import imu_like, value, write


class TestSensors:
    @pytest.mark.parametrize(
        ("missing", "reason"),
        [
            ({"imu": None}, "expected IMU samples (sensor_msgs/msg/Imu), found none"),
            ({"gnss": None, "pose_fixes": None}, "expected GNSS fixes or pose fixes, found neither"),
            ({"map_frame": None}, "pose fixes and a reference in map coordinates: expected a map frame"),
        ],
    )
    def test_what_cannot_be_replayed(
        self, missing: dict[str, None], reason: str, short_log: Log, at: Any, replayed: Any
    ) -> None:
        write_log(at("a.mcap"), replace(short_log, **missing))
        assert f"a.mcap: {reason}" in replayed(at("a.mcap")).refused()

    @pytest.mark.parametrize(
        "missing", [{"gnss": None, "gnss_velocity": None}, {"pose_fixes": None}, {"wheel": None}, {"reference": None}]
    )
    def test_what_can(self, missing: dict[str, None], short_log: Log, at: Any, replayed: Any) -> None:
        write_log(at("a.mcap"), replace(short_log, **missing))
        done = replayed(at("a.mcap"))
        assert (done.left_out(), done.warnings()) == ({}, [])
        scored = done.metrics["methods"]["fusion"]["lat"]
        assert scored is None if "reference" in missing else scored["rmse"] < 0.05

    def test_gnss_before_and_after_the_imu(self, short_log: Log, at: Any, replayed: Any) -> None:
        assert short_log.imu is not None
        write_log(at("a.mcap"), replace(short_log, imu=short_log.imu[1000:3000]))
        done = replayed(at("a.mcap"))
        counts = done.metrics["decisions"]["gnss_position"]
        assert counts["outside_imu"] == 301
        assert counts["before_alignment"] >= 100
        assert done.metrics["duration_s"] == pytest.approx(20.0, abs=0.2)

    def test_an_imu_gap_of_seconds(self, short_log: Log, at: Any, replayed: Any) -> None:
        assert short_log.imu is not None
        keep = np.ones(len(short_log.imu), bool)
        keep[2000:2500] = False
        write_log(at("a.mcap"), replace(short_log, imu=short_log.imu[keep]))
        done = replayed(at("a.mcap"))
        assert [(source, reason[:14], n) for (source, reason), n in done.left_out().items()] == [
            ("imu", "gap over 0.5 s", 1)
        ]
        assert done.metrics["methods"]["fusion"]["ar"] > 0.95

    @pytest.mark.parametrize("rows", [slice(0, 2), slice(0, None, 6000)])
    def test_two_imu_samples(self, rows: slice, short_log: Log, at: Any, replayed: Any) -> None:
        assert short_log.imu is not None
        write_log(at("a.mcap"), replace(short_log, imu=short_log.imu[rows]))
        assert replayed(at("a.mcap")).warnings() == ["never_aligned"]

    def test_a_reference_of_one_sample(self, short_log: Log, at: Any, replayed: Any) -> None:
        assert short_log.reference is not None
        write_log(at("a.mcap"), replace(short_log, reference=short_log.reference[2000:2001]))
        done = replayed(at("a.mcap"))
        assert "Not evaluated: too little reference: 1 epochs" in done.text
        assert done.metrics["methods"]["fusion"]["ar"] is None


@pytest.fixture
def still(short_log: Log) -> Log:
    """A vehicle that stands for all of the log."""
    assert short_log.imu is not None
    assert short_log.gnss is not None
    rng, n, m = np.random.default_rng(0), len(short_log.imu), len(short_log.gnss)
    imu = replace(short_log.imu, gyro=rng.normal(0, 1e-4, (n, 3)), accel=rng.normal((0, 0, 9.808), 0.01, (n, 3)))
    return Log(imu=imu, gnss=replace(short_log.gnss, llh=np.tile(short_log.gnss.llh[0], (m, 1))))


class TestNoSuccess:
    """Results that must not look like one."""

    def test_at_rest_for_all_of_the_log(self, still: Log, at: Any, replayed: Any) -> None:
        write_log(at("a.mcap"), still)
        done = replayed(at("a.mcap"))
        assert done.warnings() == ["never_aligned"]
        assert "it needs IMU, a position and a heading" in done.text

    @pytest.mark.parametrize(
        ("gyro", "accel", "kind", "text"),
        [
            (1.0, 1 / 9.80665, "specific_force", "expected about (0, 0, 9.8), z up (is it in g?)"),
            (1.0, np.array((1, -1, -1)), "specific_force", "z up (does z point down?)"),
            (180 / np.pi, 1.0, "turn_rate", "expected below 2 (is it in deg/s?)"),
            (1.0, 0.0, "specific_force", "IMU: the median specific force is (0.00, 0.00, 0.00) m/s^2"),
        ],
    )
    def test_an_imu_in_other_units_or_axes(
        self, gyro: Any, accel: Any, kind: str, text: str, short_log: Log, at: Any, replayed: Any,
        capsys: pytest.CaptureFixture[str],
    ) -> None:  # fmt: skip
        assert short_log.imu is not None
        imu = short_log.imu
        write_log(at("a.mcap"), imu_like(short_log, gyro=imu.gyro * gyro, accel=imu.accel * accel))
        done = replayed(at("a.mcap"))
        assert done.error == ""
        assert done.warnings()[0] == kind
        assert {"lost", "rejected"} & set(done.warnings())  # it starts again and again, and is lost in between
        assert text in done.text
        assert main(["info", str(at("a.mcap"))]) == 0
        assert text in " ".join(capsys.readouterr().out.split())

    def test_a_filter_that_lost_track(self, short_log: Log, at: Any, replayed: Any) -> None:
        """Fixes jump by 1000 km: every one is rejected from then on (the last, at 60 s, is hidden)."""
        bare = Log(short_log.imu, short_log.gnss, short_log.gnss_velocity, vehicle=short_log.vehicle)
        done = replayed(write(at("a.mcap"), bare, {"/gnss/fix": value("latitude", 57.0, 250)}), "--hide-gnss", "15:2")
        assert done.warnings() == ["lost", "rejected"]
        assert re.search(r"The filter lost track: from 25\.0 to 59\.9 s it rejected all 3\d\d positions\.", done.text)
        assert "…" not in done.text, "a column is cut off"

    def test_a_filter_that_is_not_finite(
        self, short_log: Log, at: Any, replayed: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def diverged(session: Session, piece: Log) -> FusionResult:
            result = push(session, piece)
            llh, vel = result.states.llh.copy(), result.states.vel_enu.copy()
            llh[200:], vel[190:200] = np.nan, 1e200
            return replace(result, states=replace(result.states, llh=llh, vel_enu=vel))

        push = Session.push
        monkeypatch.setattr(Session, "push", diverged)
        write_log(at("a.mcap"), short_log)
        done = replayed(at("a.mcap"))
        assert done.warnings() == ["not_finite", "too_fast"]
        assert re.search(r"[34]\d\d of 5\d\d states are not finite, the first after 20\.\d s\.", done.text)
        assert 0.3 < done.metrics["methods"]["fusion"]["coverage"] < 0.4
        assert done.metrics["methods"]["fusion"]["ar"] < 0.4
