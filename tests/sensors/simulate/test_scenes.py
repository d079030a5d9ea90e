"""Tags of a drive: they say what the course says, at its times; night and autonomous drives as often as planned."""

import numpy as np
import pytest

from sensors.simulate.course import Course
from sensors.simulate.driver import Driver
from sensors.simulate.environment import Environment
from sensors.simulate.planning import plan_drive
from sensors.simulate.scenes import ScenePlan, drive_tags, mode_tags, scene_tags
from tests.sensors.simulate.roads import ENVIRONMENTS, PLAN, START_LLH, START_NS

SECOND = 1_000_000_000


def course() -> Course:
    """10 m/s for 10 s, 10 s of rest, 10 m/s again; a tunnel from 50 m to 100 m, where the rest is, and from 150 m."""
    t = np.array([0.0, 10.0, 20.0, 40.0])
    return Course(
        t_ns=START_NS + np.rint(t * 1e9).astype(np.int64),
        s=np.array([0.0, 100.0, 100.0, 300.0]),
        names=("city", "tunnel"),
        environments=(Environment(), Environment()),
        edges=np.array([0.0, 50.0, 100.0, 150.0, 400.0]),
        kind=np.array([0, 1, 0, 1]),
        bias_at=np.zeros(1),
        bias=np.zeros((1, 3)),
    )


def test_scene_tags_change_where_the_course_does() -> None:
    tags = scene_tags(course(), START_NS, START_NS + 40 * SECOND)
    assert tags.text.tolist() == ["city", "tunnel", "city", "tunnel"]
    np.testing.assert_array_equal(tags.t_ns - START_NS, np.array([0, 5, 10, 25]) * SECOND)
    dark = scene_tags(course(), START_NS + 6 * SECOND, START_NS + 20 * SECOND, night=True)
    assert dark.text.tolist() == ["tunnel,night", "city,night"]
    np.testing.assert_array_equal(dark.t_ns - START_NS, np.array([6, 10]) * SECOND)


def test_the_last_kilometres_are_autonomous() -> None:
    end = START_NS + 40 * SECOND
    assert mode_tags(course(), START_NS, end, 0.0).text.tolist() == ["open-loop"]
    assert mode_tags(course(), START_NS, end, 1.0).text.tolist() == ["autonomous"]
    half = mode_tags(course(), START_NS, end, 0.5)
    assert half.text.tolist() == ["open-loop", "autonomous"]
    np.testing.assert_array_equal(half.t_ns - START_NS, np.array([0, 25]) * SECOND)


def test_night_and_autonomous_drives_are_drawn_by_their_shares() -> None:
    plan = ScenePlan(night=0.3, autonomous_drives=0.5, autonomous_share=0.25)
    drawn = [drive_tags(course(), START_NS, 40.0, plan, seed) for seed in range(400)]
    assert np.mean([tags.night for tags in drawn]) == pytest.approx(0.3, abs=0.07)
    assert np.mean([len(tags.mode) == 2 for tags in drawn]) == pytest.approx(0.5, abs=0.08)
    for tags in drawn[:20]:
        assert all(text.endswith(",night") == tags.night for text in tags.scene.text.tolist())
        if len(tags.mode) == 2:
            assert tags.mode.t_ns[1] - START_NS == 32.5 * SECOND
    again = drive_tags(course(), START_NS, 40.0, plan, 7)
    np.testing.assert_array_equal(again.scene.text, drawn[7].scene.text)


def test_tunnels_lie_where_the_course_says() -> None:
    drive = plan_drive(PLAN, ENVIRONMENTS, Driver(), START_LLH, START_NS, 1, length_km=30.0)
    end = START_NS + round(drive.duration_s * 1e9)
    tags = scene_tags(drive.course, START_NS, end)
    t_ns = np.arange(START_NS, end, SECOND // 10)
    held = tags.text[np.searchsorted(tags.t_ns, t_ns, side="right") - 1]
    there = np.array(drive.course.names)[drive.course.environment(drive.course.place(t_ns))]
    assert np.mean(held == there) > 0.999
    assert "tunnel" in set(held.tolist())
    assert (tags.text[1:] != tags.text[:-1]).all()
