"""egoloc predict: where searches begin, what becomes of the log, and one real drive from frames to fused states."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from egovm.config import PRESETS
from egovm.dataset import NOISES, planar
from egovm.map_elements import Pieces
from egovm.match import Match, nothing, planar_of
from replay.cli import main
from replay.config import RunConfig
from replay.predict import Chosen, Setting, at_point, predict
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.frames import Frame, Sweep
from sensors.maps.map_file import MapFile, open_map
from sensors.maps.store import write_map
from sensors.maps.vector_map import VectorMap
from sensors.mcap.frames import read_frames
from sensors.mcap.io import read_log, write_log
from sensors.motion import AlongTrajectory, Motion, along
from sensors.records import Log, PoseFix
from sensors.simulate.drive import simulate
from sensors.simulate.scenarios import load
from sensors.simulate.surroundings import drive_frames, drive_map

Floats = NDArray[np.float64]

SECONDS, SEED = 40.0, 100_002
NO_PIECES = Pieces(
    np.empty(0, np.int64),
    np.empty((0, 2, 3), np.float32),
    np.empty(0, np.float32),
    np.empty((0, 3), np.float32),
    np.empty((0, 2), np.float32),
)
SIGMA = np.array((0.03, 0.02, 0.0005))


class TrueMatcher:
    """Finds the true pose of every third frame and more, whatever it is shown; keeps where the searches began."""

    config = PRESETS["small-lidar"]

    def __init__(self, truth: AlongTrajectory) -> None:
        self.truth = truth
        self.began: list[tuple[int, Floats, Motion]] = []
        self.semantic: set[int] = set()

    def __call__(self, frame: Frame, _: MapFile, T_map_init: Floats, motion: Motion, **asked: Any) -> Match:
        self.began.append((frame.t_ns, T_map_init, motion))
        self.semantic |= {frame.t_ns} if asked["semantics"] else set()
        answer = nothing("no landmarks", T_map_init, 3, 0)
        if len(self.began) % 3:
            pose = self.truth.poses.pose(frame.t_ns)
            answer = answer._replace(reason="", T_map_body=pose, cov=np.diag(SIGMA**2))
        facts = {"T_map_init": T_map_init, "T_body_lifted": np.eye(4), "seconds": 0.01, "pieces": NO_PIECES}
        seen = {"t_ns": frame.t_ns, "arrival_ns": frame.arrival_ns, "batch": None, "output": None}
        return Match(**facts, **seen, **answer._asdict())  # type: ignore[arg-type]

    def offsets(self) -> Floats:
        """(N, 3) of the true poses in the initial ones, m, m, rad."""
        return np.array([planar_of(np.linalg.inv(T) @ self.truth.poses.pose(t)) for t, T, _ in self.began])


class Made:
    """A drive with frames twice a second, and its map."""

    def __init__(self, folder: Path) -> None:
        self.log, self.map = folder / "drive.mcap", folder / "map.parquet"
        scenario = load("survey")
        self.drive = simulate(SECONDS, SEED, scenario)
        start = int(self.drive.reference.t_ns[0])  # type: ignore[union-attr]
        stamps = range(start + NS_PER_S, start + int((SECONDS - 1) * NS_PER_S), NS_PER_S // 2)
        points = Sweep(np.array([[10.0, 0.0, 0.0]], np.float32))
        write_log(self.log, self.drive, frames=(Frame(t, t + 100_000_000, (points,)) for t in stamps))
        write_map(drive_map(SECONDS, SEED, scenario), self.map)
        self.frames = len(stamps)

    def matcher(self) -> TrueMatcher:
        assert self.drive.reference is not None
        return TrueMatcher(along(self.drive.reference))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return Made(tmp_path_factory.mktemp("drive"))


@pytest.fixture
def vector_map(made: Made) -> Iterator[MapFile]:
    with open_map(made.map) as opened:
        yield opened


def setting(matcher: TrueMatcher, vector_map: MapFile, init: str, seed: int = 0, config: Any = None) -> Setting:
    return Setting(matcher, vector_map, init, seed, None, config or RunConfig())  # type: ignore[arg-type]


def test_the_log_goes_on_with_the_new_fixes_alone(made: Made, vector_map: MapFile, tmp_path: Path) -> None:
    matcher, target = made.matcher(), tmp_path / "out.mcap"
    tally = predict(made.log, target, setting(matcher, vector_map, "reference+uniform"), Chosen(0.0, 0))
    found, before = read_log(target), made.drive
    assert found.pose_fixes is not None
    assert tally.found() | {"ms": None} == {
        "frames": made.frames,
        "matched": made.frames,
        "fixes": len(found.pose_fixes),
        "at_edge": 0,
        "with_two_modes": 0,
        "left_out": {"no landmarks": made.frames // 3},
        "map_pieces_left_out": 0,
        "log_left_out": [],
        "ms": None,
    }
    true = np.array([planar_of(matcher.truth.poses.pose(t)) for t in found.pose_fixes.t_ns])
    assert np.allclose(found.pose_fixes.pose, true, atol=1e-6)
    assert np.allclose(found.pose_fixes.cov, np.diag(SIGMA**2), rtol=1e-6)
    assert (found.pose_fixes.arrival_ns - found.pose_fixes.t_ns == 100_000_000).all()
    for name in ("imu", "gnss", "gnss_velocity", "wheel", "reference"):
        assert np.array_equal(getattr(found, name).t_ns, getattr(before, name).t_ns)
    assert not list(read_frames(target))
    predict(made.log, target, setting(made.matcher(), vector_map, "reference"), Chosen(0.0, 0), keep_frames=True)
    assert len(list(read_frames(target))) == made.frames


def test_noise_is_of_the_frame_and_the_seed(made: Made, vector_map: MapFile, tmp_path: Path) -> None:
    found = {}
    for name, init, seed in (("a", "uniform", 0), ("b", "uniform", 0), ("c", "uniform", 1), ("d", "gauss", 0)):
        matcher = made.matcher()
        predict(made.log, tmp_path / name, setting(matcher, vector_map, f"reference+{init}", seed), Chosen(0.0, 0))
        found[name] = matcher.offsets()
    assert np.array_equal(found["a"], found["b"])
    assert not np.allclose(found["a"], found["c"])
    wide, noise = np.abs(found["a"]), NOISES["uniform"]
    assert (wide <= np.array((noise.lon_m, noise.lat_m, np.radians(noise.yaw_deg))) + 1e-9).all()
    assert (wide.max(0) > 0.8 * np.array((2.5, 2.5, np.radians(2.5)))).all()
    assert found["d"][:, 1].std() < 0.75 * found["a"][:, 1].std()


def test_poses_of_a_topic_begin_searches_and_leave_the_reference_alone(
    made: Made, vector_map: MapFile, tmp_path: Path
) -> None:
    """Those of the pose fixes that the log has, which end a little before it."""
    matcher, target = made.matcher(), tmp_path / "out.mcap"
    tally = predict(made.log, target, setting(matcher, vector_map, "/egovm/pose"), Chosen(30.0, 1))
    assert tally.fixes > 0.6 * made.frames
    away = np.abs(matcher.offsets()[:, :2]).max(axis=1)
    assert 0.01 < np.median(away) < 0.5  # as far as the simulated fixes are
    found, before = read_log(target).reference, made.drive.reference
    assert found is not None
    assert before is not None
    assert np.array_equal(found.t_ns, before.t_ns)
    assert np.allclose(found.p_map, before.p_map)


def test_frames_to_the_end_of_the_log_are_matched_as_long_as_a_pose_is_known(
    made: Made, vector_map: MapFile, tmp_path: Path
) -> None:
    drive = made.drive
    assert drive.reference is not None
    assert drive.imu is not None
    first, last = int(drive.reference.t_ns[0]), int(drive.reference.t_ns[-1])
    points = Sweep(np.array([[10.0, 0.0, 0.0]], np.float32))
    short = tmp_path / "short.mcap"
    stamps = [last - 290_000_000, last - 90_000_000, last + 100_000_000, last + 900_000_000]
    write_log(short, drive, frames=(Frame(t, t, (points,)) for t in stamps))
    for init, fixes, reason in (("reference", 2, "outside the trajectory"), ("filter", 2, "in a gap of the IMU")):
        matcher = made.matcher()
        tally = predict(short, None, setting(matcher, vector_map, init), Chosen(0.0, 10))
        assert tally.fixes == fixes
        assert tally.left_out[reason] == (2 if init == "reference" else 1)
    brief = replace(drive, reference=drive.reference[(drive.reference.t_ns < first + 60_000_000)])
    write_log(short, brief, frames=[Frame(first + 30_000_000, first, (points,))])
    assert predict(short, None, setting(made.matcher(), vector_map, "reference"), Chosen(0.0, 1)).fixes == 1


def test_the_filter_says_where_to_search_once_it_is_aligned(made: Made, vector_map: MapFile, tmp_path: Path) -> None:
    """It never saw the pose fixes that the log had: those of the matcher bring its yaw to a tenth of a degree."""
    matcher, target = made.matcher(), tmp_path / "out.mcap"
    tally = predict(made.log, target, setting(matcher, vector_map, "filter"), Chosen(0.0, 0))
    assert tally.left_out["the filter was not aligned"] > 5
    assert tally.frames == made.frames
    offsets = matcher.offsets()
    assert len(offsets) > made.frames // 2
    settled = np.abs(offsets[6:])
    assert settled[:, :2].max() < 0.3
    assert settled[:, 2].max() < np.radians(0.5)
    t, _, motion = matcher.began[-1]
    later = matcher.truth.poses.pose(t + 50_000_000)
    p = np.array([[12.0, 3.0, 0.0]])
    here = later[:3, :3] @ p[0] + later[:3, 3]
    true = matcher.truth.poses.pose(t)
    assert np.allclose(motion.carried(p, t + 50_000_000, t)[0], true[:3, :3].T @ (here - true[:3, 3]), atol=0.05)


def test_pictures_are_of_the_frames_that_were_asked_for(made: Made, vector_map: MapFile, tmp_path: Path) -> None:
    """Each begins so many seconds after the log's first frame; what need not be matched is not."""
    for init, target, matched in (
        ("reference", None, 4),
        ("filter", None, None),
        ("reference", tmp_path / "out.mcap", made.frames),
    ):
        matcher, chosen = made.matcher(), Chosen(20.0, 4)
        tally = predict(made.log, target, setting(matcher, vector_map, init), chosen)
        assert tally.frames == (matched or 40 + 4)
        stamps = [(one.match.t_ns - chosen.first_ns) / NS_PER_S for one in chosen.seen]  # type: ignore[operator]
        assert stamps == [20.0, 20.5, 21.0, 21.5]
        true = planar_of(matcher.truth.poses.pose(chosen.seen[0].match.t_ns))
        assert chosen.seen[0].truth == pytest.approx(true)
        asked = [t for t, *_ in matcher.began if t in matcher.semantic]
        assert asked == [one.match.t_ns for one in chosen.seen]
    with pytest.raises(EgolocError, match=r"expected a frame to match from 90 s on, got none"):
        predict(made.log, tmp_path / "b", setting(made.matcher(), vector_map, "reference"), Chosen(90.0, 1))
    assert len(read_log(tmp_path / "b").pose_fixes or ()) > 10  # a picture that cannot be drawn loses nothing


def test_fixes_tell_the_point_that_the_vehicle_says() -> None:
    arm = np.array((1.5, -0.4))
    fix = PoseFix(
        np.array([5], np.int64),
        np.array([6], np.int64),
        np.array([[3.0, 4.0, 0.7]]),
        np.diag((0.04, 0.01, 1e-4))[None],
        np.array([[[3.0, 4.0, 0.7], [5.0, 3.0, 0.9]]]),
        np.array([[0.7, 0.2]]),
    )
    apart = planar(np.array((0.0, 0.0, 0.7)))[:2, :2] @ arm
    moved = at_point(fix, apart)
    for given, told in ((fix.pose[0], moved.pose[0]), *zip(fix.modes[0], moved.modes[0], strict=True)):
        expected = planar(given)[:2, :2] @ arm + given[:2]
        assert np.allclose(told, (*expected, given[2]))

    def point(pose: Floats) -> Floats:
        return np.append(planar(pose)[:2, :2] @ arm + pose[:2], pose[2])

    J = np.stack([(point(fix.pose[0] + d) - point(fix.pose[0] - d)) / 2e-6 for d in 1e-6 * np.eye(3)], axis=1)
    assert np.allclose(moved.cov[0], J @ fix.cov[0] @ J.T, rtol=1e-6, atol=1e-12)


def test_what_cannot_be_matched_is_told_and_writes_nothing(
    made: Made, vector_map: MapFile, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "out.mcap"
    elsewhere = replace(vector_map.whole(), frame=msgspec.structs.replace(vector_map.frame, zone=33))
    write_map(VectorMap(elsewhere.frame, elsewhere.elements, elsewhere.surfels, ("x",), 1.0), tmp_path / "z.parquet")
    with (
        open_map(tmp_path / "z.parquet") as other,
        pytest.raises(EgolocError, match=r"z.parquet: expected a map in the"),
    ):
        predict(made.log, target, setting(made.matcher(), other, "reference"), Chosen(0.0, 0))
    bare = tmp_path / "bare.mcap"
    write_log(bare, replace(made.drive, reference=None))
    with pytest.raises(EgolocError, match=r"bare.mcap: expected a reference for --init reference, got none"):
        predict(bare, target, setting(made.matcher(), vector_map, "reference"), Chosen(0.0, 0))
    with pytest.raises(EgolocError, match=r"bare.mcap: expected a frame that gives a fix, got none: no frames"):
        predict(bare, target, setting(made.matcher(), vector_map, "filter"), Chosen(0.0, 0))
    write_log(bare, replace(made.drive, imu=None))
    with pytest.raises(EgolocError, match=r"bare.mcap: expected IMU samples for --init filter, got none"):
        predict(bare, target, setting(made.matcher(), vector_map, "filter"), Chosen(0.0, 0))
    write_log(bare, Log(imu=made.drive.imu))
    with pytest.raises(EgolocError, match=r"bare.mcap: expected a log with a map frame"):
        predict(bare, target, setting(made.matcher(), vector_map, "filter"), Chosen(0.0, 0))
    for words, message in (
        ((made.log, target), "predict: expected --map MAP"),
        ((made.log, "--map", made.map), "predict: expected DEST.mcap, --png FILE or --rrd FILE"),
        ((made.log, "--map", made.map, "--png", made.log), "drive.mcap: expected a file of its own to draw into"),
        ((made.log, "--map", made.map, "--rrd", made.map), "map.parquet: expected a file of its own to draw into"),
        ((made.log, "--map", made.map, "--png", target, "--rrd", target), "out.mcap: expected a file of its own"),
        (
            (made.log, "--map", made.map, "--png", tmp_path / "no" / "a.png"),
            "a.png: cannot be written: expected a file in a folder",
        ),
        ((made.log, target, "--map", made.map, "--ground-m", "nan"), "--ground-m: expected metres within 10 of 0"),
        (
            (made.log, target, "--map", made.map, "--weights", made.log),
            "drive.mcap: expected a name that ends in .safe",
        ),
        ((made.log, target, "--map", made.map, "--init", "reference+far"), "--init: expected filter, reference, ref"),
        ((made.log, target, "--map", made.map, "--weights", tmp_path / "no.safetensors"), "no.toml: expected the net"),
        ((made.log, made.log, "--map", made.map), "drive.mcap: expected a file to write, got the source itself"),
        ((made.log, target, "--map", made.log), "drive.mcap: expected"),
    ):
        assert main(["predict", *map(str, words)]) == 2
        assert message in capsys.readouterr().err
    assert not target.exists()


@pytest.mark.slow
def test_a_drive_from_frames_to_fused_states(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Frames of a street that the committed weights never saw; the map has what a survey of another drive would."""
    log, target, where = tmp_path / "drive.mcap", tmp_path / "out.mcap", tmp_path / "map.parquet"
    scenario = load("survey")
    drive = simulate(SECONDS, SEED, scenario)
    seen = (frame for number, frame in enumerate(drive_frames(SECONDS, SEED, scenario)) if number % 4 == 0)
    write_log(log, drive, frames=seen)
    write_map(drive_map(SECONDS, SEED, scenario), tmp_path / "streets.parquet")
    assert main(["map", "surfels", str(log), str(where), "--map", str(tmp_path / "streets.parquet")]) == 0
    assert main(["predict", str(log), str(target), "--map", str(where)]) == 0
    capsys.readouterr()
    assert main(["replay", str(target), "--out", str(tmp_path / "run"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["methods"]["egovm"]
    assert found["lon"]["mae"] < 0.06
    assert found["lat"]["mae"] < 0.06
    assert found["yaw"]["mae"] < 0.12
