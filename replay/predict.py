"""EgoVM along a log: each frame is matched against the map, and the log goes on with the fixes that were found."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egovm.config import LatticeConfig
from egovm.infer import Matcher
from egovm.match import Match, planar_of
from replay.config import RunConfig
from replay.initial_poses import InitialPoses, KnownPoses, initial_poses
from replay.match_drawing import Pictured
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.frames import Frame
from sensors.maps.frame_text import text_of
from sensors.maps.map_file import MapFile
from sensors.mcap.frames import read_frames
from sensors.mcap.io import read_pieces, write_log
from sensors.mcap.topics import CAMERA, FRAMES, LIDAR
from sensors.pieces import joined, summed
from sensors.records import LeftOut, Log, PoseFix

Floats = NDArray[np.float64]

PIECE_S = 10.0
"""Of a log, after which its frames are matched."""


class Setting(NamedTuple):
    """matcher, vector_map: what frames are matched with; init: where each search begins (``initial_poses``), seed: of
    its noise; ground_m: height of the ground under the vehicle in body axes, m, None: as the points show."""

    matcher: Matcher
    vector_map: MapFile
    init: str
    seed: int
    ground_m: float | None
    config: RunConfig


@dataclass(slots=True)
class Chosen:
    """The matches that somebody wants to see: so many from at_s after the log's first frame on."""

    at_s: float
    count: int
    seen: list[Pictured] = field(default_factory=list)
    first_ns: int | None = None

    def wants(self, frame: Frame) -> bool:
        """Whether this is one of them."""
        assert self.first_ns is not None
        return not self.complete and frame.t_ns >= self.first_ns + round(self.at_s * NS_PER_S)

    def of(self, frames: Iterable[Frame], *, until_complete: bool, alone: bool) -> Iterator[Frame]:
        """Frames of a log from its first on; until_complete: to the last of these at most; alone: these alone."""
        for frame in frames:
            if self.first_ns is None:
                self.first_ns = frame.t_ns
            if until_complete and self.complete:
                return
            if not alone or self.wants(frame):
                yield frame

    @property
    def complete(self) -> bool:
        """Whether there are enough."""
        return len(self.seen) >= self.count


@dataclass(slots=True)
class Tally:
    """What became of the frames; at_edge: fixes at the edge of the search, beyond which the truth may lie;
    log_left_out: of the log itself; seconds: of each frame that was matched, its map and inputs included."""

    frames: int = 0
    fixes: int = 0
    two_modes: int = 0
    at_edge: int = 0
    pieces_left_out: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    log_left_out: Sequence[LeftOut] = ()
    seconds: list[float] = field(default_factory=list)

    def add(self, match: Match, lattice: LatticeConfig) -> None:
        """A frame that was matched."""
        self.at_edge += match.found and _at_edge(match, lattice)
        self.seconds.append(match.seconds)
        self.pieces_left_out += match.left_out
        self.fixes += match.found
        self.two_modes += bool(match.weights[1] > 0.0)
        if not match.found:
            self.left_out[match.reason] += 1

    def found(self) -> dict[str, Any]:
        """JSON-ready."""
        ms = 1e3 * np.array(self.seconds or [np.nan])
        return {
            "frames": self.frames,
            "matched": len(self.seconds),
            "fixes": self.fixes,
            "at_edge": self.at_edge,
            "with_two_modes": self.two_modes,
            "left_out": dict(self.left_out),
            "map_pieces_left_out": self.pieces_left_out,
            "log_left_out": [asdict(row) for row in self.log_left_out],
            "ms": {"p50": float(np.median(ms)), "max": float(ms.max())} if self.seconds else None,
        }


def predict(
    log: Path,
    target: Path | None,
    setting: Setting,
    chosen: Chosen,
    *,
    keep_frames: bool = False,
    say: Callable[[str], None] = lambda _: None,
) -> Tally:
    """Match the frames of a log; the log with what was found goes to target, whole or not at all.

    Without a target the chosen frames alone are matched, with the filter those before as well. keep_frames: target has
    the frames as well.
    Raises EgolocError where the log, or what the beginning of each search needs, is not there, where map and log are of
    different map frames, and no frame gave a fix; and, once a target is written, where no match was left to choose.
    """
    topics = setting.config.topics
    columns = {sensor: topic for sensor, topic in topics.items() if sensor not in FRAMES}
    used = setting.matcher.config
    lidar = topics.get(LIDAR) if used.lidar is not None else ()
    images = used.camera is not None
    frames = read_frames(log, lidar, images=images, cameras=topics.get(CAMERA))
    matching = _Matching(log, setting, chosen, Tally())
    matched = chosen.of(frames, until_complete=target is None, alone=target is None and setting.init != "filter")
    pieces = matching.pieces(read_pieces(log, columns, PIECE_S), matched, say)
    if target is None:
        for _ in takewhile(lambda _: not chosen.complete, pieces):
            pass
    else:
        kept = read_frames(log, topics.get(LIDAR), cameras=topics.get(CAMERA)) if keep_frames else ()
        write_log(target, pieces, frames=kept)
    if chosen.count and not chosen.seen:
        raise EgolocError(f"{log}: expected a frame to match from {chosen.at_s:g} s on, got none")
    return matching.tally


class _Matching:
    """A log on its way through the matcher."""

    def __init__(self, log: Path, setting: Setting, chosen: Chosen, tally: Tally) -> None:
        self.tally = tally
        self._log, self._setting, self._chosen = log, setting, chosen
        self._starts: InitialPoses | None = None
        self._truth = KnownPoses(None, 0, (0.0, 0.0, 0.0))
        self._arm = np.zeros(3)

    def pieces(self, pieces: Iterable[Log], frames: Iterable[Frame], say: Callable[[str], None]) -> Iterator[Log]:
        """The pieces, their pose fixes replaced by what the frames say. EgolocError at the end for want of any."""
        waiting = _Waiting(frames)
        for piece, last in _with_last(self._placed(piece) for piece in pieces):
            if self._starts is None:
                self._starts = self._begin(piece)
            self._starts.add(piece)
            if self._chosen.count:
                self._truth.add(piece)
            until_ns = None if last else self._starts.known_ns()
            rows = [fix for frame in waiting.until(until_ns) if len(fix := self._fix(frame, self._starts))]
            self.tally.log_left_out = summed((*self.tally.log_left_out, *piece.left_out))
            say(f"{self.tally.fixes} pose fixes of {self.tally.frames} frames")
            yield replace(piece, pose_fixes=joined(rows) if rows else None)
        lacking = None if self._starts is None else self._starts.lacks()
        if lacking is not None:
            raise EgolocError(f"{self._log}: expected {lacking}")
        if not self.tally.fixes:
            reasons = ", ".join(f"{count} {reason}" for reason, count in self.tally.left_out.most_common())
            raise EgolocError(f"{self._log}: expected a frame that gives a fix, got none: {reasons or 'no frames'}")

    def _placed(self, piece: Log) -> Log:
        """With the config's vehicle and map frame."""
        config = self._setting.config
        return replace(piece, vehicle=config.vehicle or piece.vehicle, map_frame=config.map_frame or piece.map_frame)

    def _begin(self, first: Log) -> InitialPoses:
        frame, setting = first.map_frame, self._setting
        if frame is None:
            raise EgolocError(f"{self._log}: expected a log with a map frame, or map_frame in --config, got none")
        if frame != setting.vector_map.frame:
            where, theirs = setting.vector_map.path, setting.vector_map.frame
            raise EgolocError(
                f"{where}: expected a map in the log's map frame, {text_of(frame)}, got {text_of(theirs)} (map import"
                " --frame LOG)"
            )
        self._truth = KnownPoses(None, 0, first.vehicle.reference_lever_arm)
        self._arm = np.array(first.vehicle.pose_lever_arm)
        return initial_poses(self._log, setting.init, setting.seed, first.vehicle, frame, setting.config)

    def _fix(self, frame: Frame, starts: InitialPoses) -> PoseFix:
        """What a frame says, no row where it says nothing."""
        start = starts.at(frame)
        if isinstance(start, str):
            self._leave_out(start)
            return _NO_FIX
        self.tally.frames += 1
        wanted, setting = self._chosen.wants(frame), self._setting
        T, motion = start
        match = setting.matcher(frame, setting.vector_map, T, motion, ground_m=setting.ground_m, semantics=wanted)
        self.tally.add(match, setting.matcher.config.solver.lattice)
        if wanted:
            self._chosen.seen.append(Pictured(match, setting.matcher.config.bev, self._true_pose(frame), frame, motion))
        fix = at_point(match.fix(), match.T_map_body[:2, :3] @ self._arm)
        if len(fix):
            starts.take(fix)
        return fix

    def _leave_out(self, reason: str) -> None:
        self.tally.frames += 1
        self.tally.left_out[reason] += 1

    def _true_pose(self, frame: Frame) -> Floats | None:
        found = self._truth.at(frame)
        return None if isinstance(found, str) else planar_of(found.T_map_body)


def _at_edge(match: Match, lattice: LatticeConfig) -> bool:
    """Whether a match moved as far as the first level searches, but for a step."""
    moved = planar_of(np.linalg.inv(match.T_map_init) @ match.T_map_body)
    reach = np.array((lattice.half_m, lattice.half_m, np.radians(lattice.half_deg)))
    return bool((np.abs(moved) > reach * (1.0 - 1.0 / lattice.reach)).any())


def at_point(fix: PoseFix, apart: Floats) -> PoseFix:
    """Fixes of the body's origin as those of a point of the body that lies apart (2,) m, map axes."""
    x, y = apart
    J = np.array(((1.0, 0.0, -y), (0.0, 1.0, x), (0.0, 0.0, 1.0)))
    turn = fix.modes[..., 2] - fix.pose[:, None, 2]
    c, s = np.cos(turn), np.sin(turn)
    modes = fix.modes + np.stack((c * x - s * y, s * x + c * y, np.zeros_like(turn)), axis=-1)
    return replace(fix, pose=fix.pose + np.array((x, y, 0.0)), cov=J @ fix.cov @ J.T, modes=modes)


def _with_last(pieces: Iterable[Log]) -> Iterator[tuple[Log, bool]]:
    """Each piece, and whether it is the last one."""
    before: Log | None = None
    for piece in pieces:
        if before is not None:
            yield before, False
        before = piece
    if before is not None:
        yield before, True


class _Waiting:
    """Frames, each given out once its time has come."""

    def __init__(self, frames: Iterable[Frame]) -> None:
        self._frames = iter(frames)
        self._next = next(self._frames, None)

    def until(self, t_ns: int | None) -> Iterator[Frame]:
        """Those up to a time; None: the rest."""
        while self._next is not None and (t_ns is None or self._next.t_ns <= t_ns):
            yield self._next
            self._next = next(self._frames, None)


_NO_FIX = PoseFix(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))
