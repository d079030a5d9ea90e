"""The consistency benchmark: its arithmetic by hand, white noise told truly and falsely, its JSON and table."""

import json

import msgspec
import numpy as np
import pytest

from replay.bench import consistency as bench
from replay.cli import main
from replay.table import output_console
from sensors.simulate.drive import simulate_drive
from sensors.simulate.scenarios import load

FEW = 10


@pytest.fixture(scope="module")
def white() -> dict[str, bench.Floats]:
    return bench.case_scores(bench.cases()[0], FEW, None, lambda _: None)


@pytest.mark.parametrize("block", list(bench.BLOCKS))
def test_white_errors_that_are_stated_truly(white: dict[str, bench.Floats], block: str) -> None:
    """Biases hardly change within a drive, so that ten drives are thirty numbers: 1 +- 0.26."""
    scores, dof = white[block], len(bench.BLOCKS[block])
    known = scores[np.isfinite(scores)]
    assert scores.shape == (FEW, 101)
    assert np.isfinite(scores).mean() > 0.85
    slow = "bias" in block
    assert known.mean() / dof == pytest.approx(1.0, abs=0.6 if slow else 0.15)
    low, high = bench._chi_square(0.025, dof), bench._chi_square(0.975, dof)
    assert ((known > low) & (known < high)).mean() > (0.8 if slow else 0.9)


def test_errors_that_are_larger_than_stated_show() -> None:
    gnss, pose = bench.AS_DRAWN.gnss, bench.AS_DRAWN.pose
    bold = msgspec.structs.replace(
        bench.AS_DRAWN,
        gnss=msgspec.structs.replace(gnss, inflation=0.25, velocity_inflation=0.25),
        pose=msgspec.structs.replace(pose, inflation=0.25),
    )
    scores = bench.nees(simulate_drive(60.0, 1, load("clean")), bold)
    assert np.nanmean(scores["position"]) / 3 > 2.0
    assert np.nanmean(scores["velocity"]) / 3 > 1.5


def test_errors_that_last_are_what_the_case_says() -> None:
    """Nothing but lasting errors: no rejected measurement, and the shares and lengths of road-test."""
    road, case = load("road-test"), bench.cases()[1].scenario
    assert case.pose_fix.map_fraction + case.pose_fix.feature_fraction == pytest.approx(0.8)
    assert case.gnss.correlated_fraction == road.gnss.correlated_fraction == pytest.approx(0.8)
    drive = simulate_drive(60.0, 1, case)
    assert drive.log.gnss is not None
    assert (drive.log.gnss.status == 4).all()
    assert len(drive.log.gnss) == 601
    scores = bench.nees(drive, bench.AS_DRAWN)
    assert np.nanmean(scores["pose"]) / 6 > 3.0


def test_the_part_of_epochs_inside() -> None:
    rng = np.random.default_rng(1)
    honest = rng.chisquare(3, (50, 4000))
    assert bench.inside(honest, 3) == pytest.approx(0.95, abs=0.015)
    assert bench.inside(1.5 * honest, 3) < 0.2
    assert bench.inside(0.6 * honest, 3) < 0.2
    half = np.where(rng.random(honest.shape) < 0.5, np.nan, honest)
    assert bench.inside(half, 3) == pytest.approx(0.95, abs=0.015)


def test_health_of_a_covariance() -> None:
    scale = np.array([1e-6, 3.0, 1e4, 0.0])
    P = np.outer(scale, scale) * np.array([[1, 0.6, 0, 0], [0.6, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]])
    assert bench.health_of(P) == (pytest.approx(0.0, abs=1e-15), pytest.approx(0.4 / 1.6))
    P[0, 1] *= 1.5
    assert bench.health_of(P)[0] == pytest.approx(0.3)
    P[2, 2] = -1.0
    assert np.isnan(bench.health_of(P)).all()


def test_its_json_and_its_table(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    run = bench.run
    monkeypatch.setattr(bench, "run", lambda seeds, **options: run(seeds, hours=0.1, **options))
    short = [bench.Case(c.name, c.scenario, 20.0, c.config) for c in bench.cases()]
    monkeypatch.setattr(bench, "cases", lambda: tuple(short))
    assert main(["bench", "consistency", "--seeds", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["bench"] == "consistency"
    assert found["conditions"]["seeds"] == 2
    named = {(row["name"], row["metric"]): row for row in found["rows"]}
    assert len(named) == 4 * 7 * 3 + 2
    assert {case for case, _, _ in (name.partition(":") for name, _ in named)} == {
        *("white", "lasting errors", "lasting errors, by default", "road-test", "0.1 h"),
    }
    assert named["0.1 h", "largest asymmetry"]["max"] < 1e-12
    assert 0 < named["0.1 h", "eigenvalue ratio"]["min"] <= 1
    output_console().print(bench.table(found))
    printed = capsys.readouterr().out
    assert "white: gyro bias" in printed
    assert "0.1 h: P, eigenvalue ratio" in printed
    assert main(["bench", "consistency", "--seeds", "0"]) == 2
    assert "--seeds: expected 1 or more, got 0" in capsys.readouterr().err


@pytest.mark.slow
def test_a_day_harms_no_covariance() -> None:
    asymmetry, ratio = bench.health_over(24.0, bench.FusionConfig(), lambda _: None)
    print(f"largest asymmetry {max(asymmetry):.2g}, least eigenvalue ratio {min(ratio):.2g}")
    assert len(ratio) > 8600
    assert max(asymmetry) < 1e-9
    assert min(ratio) > 1e-9


@pytest.mark.slow
def test_two_hundred_drives_with_white_errors() -> None:
    """Of all NEES at least 90 % in their 95 % interval, block by block; their mean within what 200 drives can tell."""
    for block, scores in bench.case_scores(bench.cases()[0], 200, None, lambda _: None).items():
        dof = len(bench.BLOCKS[block])
        known = scores[np.isfinite(scores)]
        low, high = bench._chi_square(0.025, dof), bench._chi_square(0.975, dof)
        single, mean = ((known > low) & (known < high)).mean(), known.mean() / dof
        print(f"{block}: {mean:.3f}, {100 * single:.1f} %, of epochs {100 * bench.inside(scores[:, 15:], dof):.1f} %")
        assert single >= 0.9, block
        assert mean == pytest.approx(1.0, abs=0.1), block
