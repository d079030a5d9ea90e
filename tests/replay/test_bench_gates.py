"""`egoloc bench gates`: scenes as they are meant, ways of gating as they are meant, and the report."""

import json

import msgspec
import numpy as np
import pytest

from fusion.result import Reason, Sensor
from fusion.run import run as fuse
from replay.bench import gates
from replay.bench.gate_scenes import (
    DASH_M,
    LANE_M,
    SCENES,
    STEP_DEG,
    STEP_M,
    Scene,
    blind_road,
    canyon,
    flat_road,
    informed,
    lane,
    tunnel,
    wrong_fix,
)
from replay.bench.gates import METHODS, scored
from replay.cli import main
from sensors.records import Log, PoseFix

SEED = 2
NAIVE, CHI_SQUARE, WHOLE, OURS = (METHODS[name] for name in list(METHODS)[:4])


def seconds(log: Log, t_ns: np.ndarray) -> np.ndarray:
    assert log.imu is not None
    result: np.ndarray = (t_ns - log.imu.t_ns[0]) * 1e-9
    return result


def fixes_of(log: Log) -> PoseFix:
    assert log.pose_fixes is not None
    return log.pose_fixes


def test_what_a_flat_histogram_says_is_the_filters_own_prediction() -> None:
    """The replay of the log meets every blind fix at its prediction along the road, to the decimetre that was added.

    An error that lasts would be taken off the innovation.
    """
    white = msgspec.structs.replace(NAIVE.config.pose, white_share=1.0, lasting_share=0.0)
    method = NAIVE._replace(config=msgspec.structs.replace(NAIVE.config, pose=white))
    log = blind_road(SEED, method)
    decisions = fuse(log, method.config).decisions
    rows = decisions.sensor == Sensor.POSE_FIX
    s = seconds(log, decisions.t_ns[rows])
    blind = (s > 60.0) & (s < 150.0)
    along = decisions.innovation[rows][blind, 0]
    assert (decisions.reason[rows][blind] == Reason.ACCEPTED).all()
    assert along.std() == pytest.approx(0.1, rel=0.1)
    assert abs(along.mean()) < 0.01


def test_only_the_covariance_of_every_level_shows_that_coarse_ones_are_flat() -> None:
    reasons = {}
    for name, method in (("finest", CHI_SQUARE), ("every", OURS)):
        log = flat_road(SEED, method)
        decisions = fuse(log, OURS.config).decisions
        rows = decisions.sensor == Sensor.POSE_FIX
        s = seconds(log, decisions.t_ns[rows])
        reasons[name] = decisions.reason[rows][(s > 60.0) & (s < 150.0)]
        sigma = np.sqrt(np.linalg.eigvalsh(fixes_of(log).cov[:, :2, :2])[:, 1])
        blind = (seconds(log, fixes_of(log).t_ns) >= 60.0) & (seconds(log, fixes_of(log).t_ns) < 150.0)
        assert np.median(sigma[blind]) == pytest.approx(0.15 if name == "finest" else 2.04, rel=0.02)
        assert np.median(sigma[~blind]) == pytest.approx(0.05, rel=0.01)
    assert (reasons["every"] == Reason.PARTLY_ACCEPTED).all()
    assert (reasons["finest"] == Reason.ACCEPTED).mean() > 0.5


def test_only_a_careful_way_is_told_of_the_lattice() -> None:
    scene = SCENES["coarse lattice"]
    log = scene.log(SEED, CHI_SQUARE)
    nodes = fixes_of(log).pose / [STEP_M, STEP_M, np.radians(STEP_DEG)]
    assert np.abs(nodes - np.round(nodes)).max() < 1e-6
    assert informed(scene, CHI_SQUARE) == CHI_SQUARE
    assert informed(SCENES["gross frames"], OURS) == OURS
    worse, ours = (scored(log, informed(scene, method).config) for method in (CHI_SQUARE, OURS))
    assert informed(scene, OURS).config.pose.step_m == STEP_M
    assert ours[0] > worse[0] + 0.05
    assert ours[1] < 0.5 * worse[1]


def test_aliases_are_a_dash_and_a_lane_off() -> None:
    dashes, lanes = fixes_of(tunnel(SEED, OURS)), fixes_of(lane(SEED, OURS))
    told = dashes.weights.any(axis=1)
    assert told.sum() == 150
    apart = np.hypot(*(dashes.modes[told, 1] - dashes.modes[told, 0])[:, :2].T)
    assert apart == pytest.approx(np.full(150, DASH_M))
    assert not lanes.weights.any()
    right = fixes_of(wrong_fix(SEED, OURS))
    off = np.hypot(*(lanes.pose - right.pose)[:, :2].T)
    assert off.max() == pytest.approx(LANE_M)
    assert (off > 1.0).sum() == 1700


def test_each_naive_way_fails_in_its_scene_and_ours_does_not() -> None:
    """Accept everything: a wrong fix. Chi-square alone: dashes after a stretch without fixes, and a steady alias."""
    for scene, naive in ((wrong_fix, NAIVE), (tunnel, CHI_SQUARE), (lane, CHI_SQUARE)):
        worse, ours = (scored(scene(SEED, method), method.config) for method in (naive, OURS))
        print(f"{scene.__name__}: AR {worse[0]:.3f} and {ours[0]:.3f}, peak {worse[1]:.2f} and {ours[1]:.2f} m")
        assert ours[0] > worse[0] + 0.05
        assert worse[1] > 0.6
        assert ours[1] < 0.7 * worse[1]


def test_robust_kernels_help_against_reflections() -> None:
    """On the worst of the drives: on most the gate alone does as well."""
    found = {}
    for name in ("ours", "ours, Cauchy"):
        config = METHODS[name].config
        found[name] = np.array([scored(canyon(seed, OURS), config) for seed in range(100_000, 100_004)])
        print(f"{name}: AR {found[name][:, 0].round(3)}, peak {found[name][:, 1].round(2)} m")
    plain, cauchy = found["ours"], found["ours, Cauchy"]
    assert cauchy[:, 0].min() > plain[:, 0].min() + 0.01
    assert cauchy[:, 1].max() < 0.5 * plain[:, 1].max()


def test_the_report(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Two scenes, two ways: JSON as every benchmark's, and a table that says the same."""
    monkeypatch.setattr(gates, "SCENES", {name: SCENES[name] for name in ("gross frames", "wrong RTK fix")})
    monkeypatch.setattr(gates, "METHODS", {name: METHODS[name] for name in ("accept everything", "ours")})
    monkeypatch.setattr(gates, "FIRST_SEED", SEED)
    assert main(["bench", "gates", "--drives", "1", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["bench"], result["ratios"], result["conditions"]["seeds"]) == ("gates", {}, [SEED])
    assert [entry["metric"] for entry in result["rows"]] == ["ar", "peak_m"] * 4
    row = next(entry for entry in result["rows"] if entry["name"] == "wrong RTK fix: accept everything")
    assert row["min"] == row["median"] == row["max"] < 0.95
    assert main(["bench", "gates", "--drives", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    shares, errors = (text.split()[3:] for text in lines if text.startswith("wrong RTK fix"))
    assert shares[:2] == [f"{100 * row['median']:.1f}", f"({100 * row['min']:.1f})"]
    peak = next(
        entry for entry in result["rows"] if entry["name"] == "wrong RTK fix: ours" and entry["metric"] == "peak_m"
    )
    assert errors[2:] == [f"{peak['median']:.2f}", f"({peak['max']:.2f})"]


def test_every_scene_says_what_goes_wrong() -> None:
    for name, scene in SCENES.items():
        assert isinstance(scene, Scene), name
        assert len(scene.story) > 20
        assert (scene.log.__doc__ or "").strip()
