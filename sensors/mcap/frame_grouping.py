"""Which sweeps and images of a log make one frame: in_order, then grouped. Bounded memory: a few tenths of a second.

- Sweeps of several topics are one frame if their stamps lie at most TOGETHER_NS apart, at most one of each topic (a
  compensated sweep only with those of its own stamp: its points hold for that). Its t_ns is the first of their stamps.
- An image belongs to the frame whose t_ns is nearest its own stamp, at most TOGETHER_NS away; of several of one
  camera the nearest is taken, for cameras often run faster than LiDARs. It keeps its own stamp.
- Without LiDARs images make frames by themselves, by the rule of sweeps.
"""

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from sensors.clock import NS_PER_S
from sensors.frames import Frame, Sweep
from sensors.images import Image

TOGETHER_NS = 50_000_000
"""Sweeps of several LiDARs, and images, with stamps this close are one frame: half a turn at 10 Hz."""
LATE_NS = 200_000_000
"""A message may come so much later (by stamp) than a newer one; what comes later still is left out."""

LeaveOut = Callable[[str, str], None]
"""Counts a topic's message that is not used, with the reason."""


@dataclass(frozen=True, eq=False)
class Seen:
    """A sweep or an image with its topic, stamp and log time. rank: the place of its topic among those of its kind."""

    topic: str
    rank: int
    t_ns: int
    log_time: int
    part: Sweep | Image

    @property
    def is_image(self) -> bool:
        return isinstance(self.part, Image)


@dataclass(eq=False)
class Group:
    """What makes one frame."""

    t_ns: int
    sweeps: list[Seen] = field(default_factory=list)
    images: dict[str, Seen] = field(default_factory=dict)
    """By topic."""

    @property
    def topic(self) -> str:
        return next(iter((*self.sweeps, *self.images.values()))).topic

    def frame(self) -> Frame:
        """Sweeps and images by rank; offsets of points are from t_ns; it came in with the last of them."""
        sweeps = sorted(self.sweeps, key=lambda seen: seen.rank)
        images = sorted(self.images.values(), key=lambda seen: seen.rank)
        return Frame(
            self.t_ns,
            max(seen.log_time for seen in (*sweeps, *images)),
            tuple(_moved(seen, self.t_ns) for seen in sweeps),
            tuple(seen.part for seen in images if isinstance(seen.part, Image)),
        )


def in_order(parts: Iterator[Seen], leave_out: LeaveOut) -> Iterator[Seen]:
    """Parts by stamp; they are held until one is LATE_NS newer."""
    waiting: list[tuple[int, bool, int, int, Seen]] = []
    newest = last = np.iinfo(np.int64).min
    for number, seen in enumerate(parts):
        if seen.t_ns < last:
            kind = "images" if seen.is_image else "sweeps"
            leave_out(seen.topic, f"{kind} that came over {LATE_NS / NS_PER_S:g} s late")
            continue
        heapq.heappush(waiting, (seen.t_ns, seen.is_image, seen.rank, number, seen))
        newest = max(newest, seen.t_ns)
        while waiting and waiting[0][0] < newest - LATE_NS:
            last = waiting[0][0]
            yield heapq.heappop(waiting)[-1]
    while waiting:
        yield heapq.heappop(waiting)[-1]


def grouped(parts: Iterator[Seen], leave_out: LeaveOut, *, lidars: bool) -> Iterator[Group]:
    """Parts in order of stamp, those of a frame together. lidars: there are some, so that frames are theirs."""
    groups: list[Group] = []
    images: list[Seen] = []
    for seen in parts:
        if lidars and seen.is_image:
            images.append(seen)
        elif groups and _belongs(seen, groups[-1]):
            _add(seen, groups[-1])
        else:
            groups.append(Group(seen.t_ns))
            _add(seen, groups[-1])
        # by then every image that is near the first group has come, and every group that might be nearer to it
        while groups and seen.t_ns > groups[0].t_ns + 2 * TOGETHER_NS:
            images = _share_out(images, groups, leave_out)
            yield groups.pop(0)
        if not groups:
            images = _near(images, seen.t_ns, leave_out)
    while groups:
        images = _share_out(images, groups, leave_out)
        yield groups.pop(0)
    _near(images, np.iinfo(np.int64).max, leave_out)


def _belongs(seen: Seen, group: Group) -> bool:
    """Whether a sweep, or an image where there are no LiDARs, is of the same frame as those before it."""
    if seen.is_image:
        return seen.t_ns - group.t_ns <= TOGETHER_NS and seen.topic not in group.images
    parts = [other.part for other in (seen, *group.sweeps)]
    rigid = any(isinstance(part, Sweep) and part.compensated for part in parts)
    apart = seen.t_ns - group.t_ns
    return apart <= (0 if rigid else TOGETHER_NS) and all(other.topic != seen.topic for other in group.sweeps)


def _add(seen: Seen, group: Group) -> None:
    if seen.is_image:
        group.images[seen.topic] = seen
    else:
        group.sweeps.append(seen)


def _share_out(images: Sequence[Seen], groups: Sequence[Group], leave_out: LeaveOut) -> list[Seen]:
    """Give the first group its images; returns those that are for later ones."""
    first = groups[0]
    later = []
    for seen in _near(images, first.t_ns, leave_out):
        apart = abs(seen.t_ns - first.t_ns)
        if apart > TOGETHER_NS or (len(groups) > 1 and abs(groups[1].t_ns - seen.t_ns) < apart):
            later.append(seen)
            continue
        held = first.images.get(seen.topic)
        if held is None or apart < abs(held.t_ns - first.t_ns):
            first.images[seen.topic] = seen
    return later


def _near(images: Sequence[Seen], t_ns: int, leave_out: LeaveOut) -> list[Seen]:
    """The images that are not too early for a frame at t_ns or after it."""
    kept = [seen for seen in images if seen.t_ns >= t_ns - TOGETHER_NS]
    for seen in images:
        if seen.t_ns < t_ns - TOGETHER_NS:
            leave_out(seen.topic, f"images with no sweep within {TOGETHER_NS / NS_PER_S:g} s")
    return kept


def _moved(seen: Seen, t_ns: int) -> Sweep:
    """A sweep whose offsets are from another stamp."""
    sweep, later = seen.part, seen.t_ns - t_ns
    assert isinstance(sweep, Sweep)
    if not later:
        return sweep
    offset_ns = sweep.offset_ns + np.int32(later)
    return Sweep(sweep.xyz, sweep.T_body_lidar, offset_ns, sweep.intensity, sweep.ring, sweep.compensated)
