"""Tags of a drive: what surrounds it, whether it is night, and who drives."""

from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import Fraction
from sensors.clock import NS_PER_S
from sensors.records import Tags
from sensors.simulate.course import Course
from sensors.simulate.noise import stream

NIGHT = "night"
OPEN_LOOP, AUTONOMOUS = "open-loop", "autonomous"


class ScenePlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is drawn for a whole drive."""

    night: Fraction = 0.0
    """Share of the drives by night, -."""
    autonomous_drives: Fraction = 0.0
    """Share of the drives that drive autonomously at all, -."""
    autonomous_share: Fraction = 1.0
    """Share of the kilometres of such a drive that are autonomous: the last ones, -."""


class DriveTags(NamedTuple):
    """scene: environments, with ",night" by night; mode: OPEN_LOOP, then AUTONOMOUS."""

    scene: Tags
    mode: Tags
    night: bool


def drive_tags(course: Course, start_ns: int, duration_s: float, plan: ScenePlan, seed: int) -> DriveTags:
    """The tags of the drive of a seed, which lasts duration_s from start_ns on."""
    rng = stream(seed, "scenes")
    night, autonomous = bool(rng.random() < plan.night), bool(rng.random() < plan.autonomous_drives)
    end_ns = start_ns + round(duration_s * NS_PER_S)
    share = plan.autonomous_share if autonomous else 0.0
    return DriveTags(
        scene_tags(course, start_ns, end_ns, night=night), mode_tags(course, start_ns, end_ns, share), night
    )


def scene_tags(course: Course, start_ns: int, end_ns: int, *, night: bool = False) -> Tags:
    """The environments that a drive passes from start_ns to end_ns, each from the time on at which it begins."""
    first, last = course.place(np.array([start_ns, end_ns]))
    inside = course.edges[(course.edges > first) & (course.edges <= last)]
    kind = course.environment(np.append(first, inside))
    t_ns = np.append(start_ns, _reached(course, inside))
    # stretches that begin within a nanosecond: the last one holds
    new = np.append(np.diff(t_ns) > 0, True)
    text = np.array([_text(name, night) for name in course.names])[kind]
    return _changes(t_ns[new], text[new])


def mode_tags(course: Course, start_ns: int, end_ns: int, share: float) -> Tags:
    """Open loop, then autonomous for the last share of the kilometres of a drive from start_ns to end_ns."""
    first, last = course.place(np.array([start_ns, end_ns]))
    if share <= 0.0:
        return _changes(np.array([start_ns]), np.array([OPEN_LOOP]))
    if share >= 1.0 or last <= first:
        return _changes(np.array([start_ns]), np.array([AUTONOMOUS]))
    handed_over = _reached(course, np.array([last - share * (last - first)]))
    return _changes(np.append(start_ns, np.maximum(handed_over, start_ns + 1)), np.array([OPEN_LOOP, AUTONOMOUS]))


def _reached(course: Course, s: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) times at which the drive first reaches s (N,) m."""
    after = np.clip(np.searchsorted(course.s, s, side="left"), 1, len(course.s) - 1)
    before = after - 1
    gone = np.clip((s - course.s[before]) / np.maximum(course.s[after] - course.s[before], 1e-12), 0.0, 1.0)
    step = (course.t_ns[after] - course.t_ns[before]).astype(np.float64)
    result: NDArray[np.int64] = course.t_ns[before] + np.rint(gone * step).astype(np.int64)
    return result


def _changes(t_ns: NDArray[np.int64], text: NDArray[np.str_]) -> Tags:
    """Tags only where the text changes."""
    keep = np.append(True, text[1:] != text[:-1])
    return Tags(t_ns[keep], t_ns[keep], text[keep])


def _text(name: str, night: bool) -> str:
    return ",".join(tag for tag in (name, NIGHT if night else "") if tag)
