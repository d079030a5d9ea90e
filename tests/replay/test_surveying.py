"""egoloc map surfels and map align on small files: what they write, and what they refuse."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tyro
from numpy.typing import NDArray

from replay.commands.surveying import Align, Surfels
from sensors.datasets.trajectory_csv import write_trajectory
from sensors.datasets.trajectory_file import read_trajectory
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.maps.builder import Builder
from sensors.maps.map_file import open_map
from sensors.maps.store import write_map
from sensors.maps.vector_map import Kind
from sensors.mcap.io import write_log
from sensors.records import Log, Trajectory
from tests.sensors.maps.street import GROUND_M, around, block, frames

Floats = NDArray[np.float64]
Run = Callable[..., dict[str, Any]]

UTM = MapFrame("utm", (455_000.0, 5_427_000.0, 110.0), 32)
SHIFTED = MapFrame("utm", (456_000.0, 5_427_000.0, 110.0), 32)
OTHER = MapFrame("utm", (456_000.0, 5_427_000.0, 110.0), 33)
STREET = block(41)
TRUTH = around(STREET, 0.25)
BIAS = np.array([0.25, -0.2, 0.1])


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """What a command prints as JSON."""

    def command(kind: type[Surfels | Align], *arguments: object) -> dict[str, Any]:
        config = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)
        tyro.cli(kind, args=[str(word) for word in arguments] + ["--json"], config=config).run(())
        printed: dict[str, Any] = json.loads(capsys.readouterr().out)
        return printed

    return command


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """log.mcap whose reference is off by BIAS, truth.csv, bare.mcap without frames, clouds and maps."""
    folder = tmp_path_factory.mktemp("survey")
    off = Trajectory(TRUTH.t_ns, TRUTH.t_ns, TRUTH.p_map + BIAS, TRUTH.q_map_body)
    seen = frames(STREET, TRUTH, every_ns=300_000_000, seed=3, azimuths=240)
    write_log(folder / "log.mcap", Log(reference=off, map_frame=UTM), frames=seen)
    write_log(folder / "bare.mcap", Log(reference=off, map_frame=UTM))
    write_trajectory(TRUTH, folder / "truth.csv")
    late = Trajectory(TRUTH.t_ns + 10**12, TRUTH.t_ns, TRUTH.p_map, TRUTH.q_map_body)
    write_trajectory(late, folder / "late.csv")
    rng = np.random.default_rng(1)
    ground = np.column_stack((rng.uniform(0.0, 20.0, (20_000, 2)), rng.normal(5.0, 0.01, 20_000)))
    np.savez(folder / "ground.npz", xyz=ground)
    np.savez(folder / "ball.npz", xyz=rng.uniform(0.0, 3.0, (3000, 3)))
    builder = Builder("hand")
    builder.add(Kind.LANE_LINE, [[0.0, 0.0, 5.0], [20.0, 0.0, 5.0]])
    write_map(builder.built(UTM, road_km=0.02), folder / "lines.parquet")
    write_map(builder.built(OTHER), folder / "other.parquet")
    return folder


def test_surfels_of_a_cloud(run: Run, folder: Path, tmp_path: Path) -> None:
    said = run(Surfels, folder / "ground.npz", tmp_path / "m.parquet", "--frame", "utm:32N:455000,5427000,110")
    with open_map(tmp_path / "m.parquet") as opened:
        found = opened.whole()
    assert said["surfels"] == len(found.surfels) == 400
    assert said["points"] == 20_000
    assert found.frame == UTM
    assert np.abs(found.surfels.z - 5.0).max() < 0.02
    assert np.degrees(np.arccos(found.surfels.normal[:, 2])).max() < 2.0


def test_surfels_of_a_log_with_the_true_trajectory(run: Run, folder: Path, tmp_path: Path) -> None:
    said = run(Surfels, folder / "log.mcap", tmp_path / "m.parquet", "--trajectory", folder / "truth.csv")
    with open_map(tmp_path / "m.parquet") as opened:
        surfels = opened.whole().surfels
    assert said["frames"] > 10
    assert said["sightings"] == 3
    assert len(surfels) > 200
    level = surfels.normal[:, 2] > 0.98
    low = level & (surfels.z < 1.0)
    assert low.sum() > 100
    assert np.sqrt(np.mean((surfels.z[low] - GROUND_M) ** 2)) < 0.02
    walls = surfels.normal[:, 2] < 0.05
    assert walls.sum() > 20
    # houses stand along the street's axes
    angle = np.arctan2(surfels.normal[walls, 1], surfels.normal[walls, 0]) - STREET.yaw
    askew = np.abs((angle + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    assert np.degrees(np.median(askew)) < 1.5


def test_the_elements_of_a_map_are_kept(run: Run, folder: Path, tmp_path: Path) -> None:
    target = tmp_path / "m.parquet"
    said = run(Surfels, folder / "ground.npz", target, "--map", folder / "lines.parquet")
    assert said["surfels_per_km"] == pytest.approx(400 / 0.02)
    with open_map(target) as opened:
        found = opened.whole()
    assert found.frame == UTM
    assert found.elements.xyz.tolist() == [[0.0, 0.0, 5.0], [20.0, 0.0, 5.0]]
    assert found.sources == ("hand", "ground.npz (surfels)")
    again = run(Surfels, folder / "ground.npz", target, "--map", target, "--cell-m", 2, "--overwrite")
    assert (again["surfels"], again["elements"]) == (100, 1)


def test_a_map_with_another_origin_is_brought_together_with_the_log(run: Run, folder: Path, tmp_path: Path) -> None:
    builder = Builder("hand")
    builder.add(Kind.LANE_LINE, [[-1000.0, 0.0, 5.0], [-980.0, 0.0, 5.0]])
    write_map(builder.built(SHIFTED), tmp_path / "lines.parquet")
    truth = ("--trajectory", folder / "truth.csv")
    run(Surfels, folder / "log.mcap", tmp_path / "m.parquet", "--map", tmp_path / "lines.parquet", *truth)
    run(Surfels, folder / "log.mcap", tmp_path / "alone.parquet", *truth)
    with open_map(tmp_path / "m.parquet") as opened, open_map(tmp_path / "alone.parquet") as other:
        found, alone = opened.whole(), other.whole().surfels
    assert found.frame == SHIFTED
    np.testing.assert_allclose(found.surfels.p, alone.p - (1000.0, 0.0), atol=1e-6)
    said = run(Align, folder / "log.mcap", tmp_path / "t.csv", "--map", tmp_path / "m.parquet")
    assert said["correction_m"]["mean"] == pytest.approx(np.hypot(*BIAS[:2]), abs=0.08)


def test_a_trajectory_in_another_frame_is_refused(run: Run, folder: Path, tmp_path: Path) -> None:
    absolute = replace(TRUTH, p_map=TRUTH.p_map + UTM.origin)
    write_trajectory(absolute, tmp_path / "absolute.csv")
    for kind, target in ((Surfels, "m.parquet"), (Align, "t.csv")):
        with pytest.raises(EgolocError, match=r"absolute\.csv: expected a trajectory in the log's map frame"):
            run(kind, folder / "log.mcap", tmp_path / target, "--trajectory", tmp_path / "absolute.csv")
        assert not (tmp_path / target).exists()


def test_surfels_far_from_the_elements_are_refused(run: Run, folder: Path, tmp_path: Path) -> None:
    builder = Builder("hand")
    builder.add(Kind.LANE_LINE, [[9000.0, 0.0, 5.0], [9020.0, 0.0, 5.0]])
    write_map(builder.built(UTM), tmp_path / "far.parquet")
    with pytest.raises(EgolocError, match=r"expected surfels near the map's elements, they lie \d\.\d km away"):
        run(Surfels, folder / "ground.npz", tmp_path / "m.parquet", "--map", tmp_path / "far.parquet")


def errors(path: Path) -> tuple[Trajectory, Floats]:
    found, _ = read_trajectory(path, UTM)
    rows = np.searchsorted(TRUTH.t_ns, found.t_ns)
    assert np.array_equal(TRUTH.t_ns[rows], found.t_ns)
    return found, found.p_map - TRUTH.p_map[rows]


def test_align_to_surfels_takes_the_error_away(run: Run, folder: Path, tmp_path: Path) -> None:
    surveyed = tmp_path / "surveyed.parquet"
    run(Surfels, folder / "log.mcap", surveyed, "--trajectory", folder / "truth.csv")
    said = run(Align, folder / "log.mcap", tmp_path / "t.csv", "--map", surveyed)
    found, off = errors(tmp_path / "t.csv")
    assert np.hypot(*off[:, :2].T).max() < 0.12
    assert said["correction_m"]["mean"] == pytest.approx(np.hypot(*BIAS[:2]), abs=0.08)
    assert said["registered"] > 10
    assert len(found) == said["rows"] > 0.9 * len(TRUTH)
    assert (found.sigma[:, 0] > 0.003).all()
    assert (found.sigma[:, 0] < 0.2).all()


def test_align_to_itself_keeps_the_shape(run: Run, folder: Path, tmp_path: Path) -> None:
    said = run(Align, folder / "log.mcap", tmp_path / "t.csv", "--sigma-m", "0.4")
    found, off = errors(tmp_path / "t.csv")
    assert np.abs(off - BIAS).max() < 0.05
    # an error that is common to the whole drive stays, and sigma says so
    assert 0.2 < np.median(found.sigma[:, 0]) < 0.4
    assert said["contradicted"] == 0
    assert said["inliers"] > 0.7


def test_the_written_trajectory_comes_back_bit_for_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    q = rng.normal(size=(5, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    q[3] = np.nan
    t = np.arange(5, dtype=np.int64) * 100_000_001 + 1_700_000_000_123_456_789
    given = Trajectory(t, t, rng.normal(size=(5, 3)) * 1e5, q, np.array([[0.01, np.nan]] * 5))
    write_trajectory(given, tmp_path / "t.csv")
    found, _ = read_trajectory(tmp_path / "t.csv", UTM)
    assert np.array_equal(found.t_ns, given.t_ns)
    assert np.array_equal(found.p_map, given.p_map)
    np.testing.assert_allclose(found.q_map_body, q, rtol=0.0, atol=1e-15)
    assert np.array_equal(found.sigma, given.sigma, equal_nan=True)


WRONG = [
    ([Surfels, "{f}/ground.npz"], "expected POINTS... and DEST"),
    ([Surfels, "{f}/ground.npz", "{t}/m"], "ground.npz: does not say where on the earth it lies: give --frame"),
    ([Surfels, "{f}/ground.npz", "{t}/m", "--frame", "utm:99N"], "99"),
    ([Surfels, "{f}/ball.npz", "{t}/m", "--frame", "enu:49,8"], "ball.npz: expected planes, got no surfel"),
    ([Surfels, "{f}/none.npz", "{t}/m", "--frame", "enu:49,8"], "none.npz: no such file"),
    ([Surfels, "{f}/ground.npz", "{f}/lines.parquet", "--frame", "enu:49,8"], "exists already"),
    ([Surfels, "{f}/ground.npz", "{t}/m", "--cell-m", "0"], "--cell-m: expected 0.1..100, got 0"),
    ([Surfels, "{f}/ground.npz", "{t}/m", "--map", "{f}/other.parquet", "--frame", "enu:49,8"], "map frame enu:49"),
    ([Surfels, "{f}/ground.npz", "{t}/m", "--trajectory", "{f}/truth.csv"], "--trajectory: expected a log"),
    ([Surfels, "{f}/log.mcap", "{f}/ground.npz", "{t}/m"], "expected clouds or one log"),
    ([Surfels, "{f}/bare.mcap", "{t}/m"], "bare.mcap: expected LiDAR frames along the trajectory, got none"),
    ([Surfels, "{f}/log.mcap", "{t}/m", "--trajectory", "{f}/late.csv"], "outside of the trajectory"),
    ([Surfels, "{f}/log.mcap", "{t}/m", "--trajectory", "{f}/none.csv"], "none.csv: no such file"),
    ([Surfels, "{f}/log.mcap", "{t}/m", "--map", "{f}/other.parquet"], "log.mcap: expected map frame utm:33N:456000"),
    ([Align, "{f}/bare.mcap", "{t}/t.csv"], "bare.mcap: expected frames with LiDAR points"),
    ([Align, "{f}/log.mcap", "{t}/t.csv", "--trajectory", "{f}/late.csv"], "outside of the trajectory"),
    ([Align, "{f}/log.mcap", "{t}/t.csv", "--map", "{f}/lines.parquet"], "lines.parquet: expected a map with surfels"),
    ([Align, "{f}/log.mcap", "{t}/t.csv", "--map", "{f}/other.parquet"], "expected map frame utm:32N:455000"),
    ([Align, "{f}/log.mcap", "{t}/t.csv", "--map", "{f}/a", "--cloud", "{f}/b"], "expected --cloud or --map, got both"),
    ([Align, "{f}/log.mcap", "{f}/truth.csv"], "truth.csv: exists already"),
    ([Align, "{f}/log.mcap", "{t}/t.csv", "--sigma-m", "nan"], "--sigma-m: expected 0.001..100, got nan"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "message"), WRONG, ids=[message for _, message in WRONG])
def test_mistakes_are_said_in_a_line_and_nothing_is_written(
    run: Run, folder: Path, tmp_path: Path, words: list[Any], message: str
) -> None:
    before = sorted(path.name for path in folder.iterdir())
    kind, *arguments = words
    with pytest.raises(EgolocError) as caught:
        run(kind, *(word.format(f=folder, t=tmp_path) for word in arguments))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []
    assert sorted(path.name for path in folder.iterdir()) == before
