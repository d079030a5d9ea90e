"""The short form of the fault matrix: no crash, no state that is not finite, no silent divergence, and back in time.

What today's filter does not tell is marked, with the reason; the whole matrix stands in docs/fault-matrix.md.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from replay.bench.faults import SHORT_S, Cell, Matrix, report
from replay.cli import main
from replay.fault_matrix import SENSOR_SETS, Outcome, Subject, acts_on, at_epochs, fused, judged, outcome, subjects
from replay.fault_tables import markdown, verdict
from sensors.simulate.faults import FAULTS
from sensors.simulate.faults.spec import parse
from sensors.simulate.gnss import displaced

SEED = 1000
ALL, NO_POSE = SENSOR_SETS
RECOVERS_S = {ALL: 20.0, NO_POSE: 40.0}
"""After the fault's end, s. GNSS alone shows a yaw that is a degree off only where the vehicle turns or speeds up."""
SILENT = {("gnss-drift", NO_POSE): "a lone receiver that drifts by 0.1 m/s is followed: nothing says that it is wrong"}
"""Fault and set of sensors -> why the states are said to be healthy."""


@pytest.fixture(scope="module")
def drives() -> dict[str, Subject]:
    return {subject.sensors: subject for subject in subjects(1, SEED, SHORT_S)}


CASES = [(name, sensors) for name, fault in FAULTS.items() for sensors in SENSOR_SETS if acts_on(fault, sensors)]


@pytest.mark.parametrize(("name", "sensors"), CASES)
def test_a_fault_is_survived(name: str, sensors: str, drives: dict[str, Subject]) -> None:
    found = medium(drives[sensors], name)
    assert found.recover_s is not None
    assert found.recover_s <= RECOVERS_S[sensors]


@pytest.mark.parametrize(
    ("name", "sensors"),
    [
        pytest.param(*case, marks=pytest.mark.xfail(strict=True, reason=SILENT[case])) if case in SILENT else case
        for case in CASES
    ],
)
def test_a_fault_is_never_silent(name: str, sensors: str, drives: dict[str, Subject]) -> None:
    found = medium(drives[sensors], name)
    assert not found.silent


@pytest.mark.parametrize(("name", "sensors"), CASES)
def test_a_fault_breaks_nothing(name: str, sensors: str, drives: dict[str, Subject]) -> None:
    found = medium(drives[sensors], name)
    assert not found.crash
    assert found.not_finite == 0


def medium(subject: Subject, name: str) -> Outcome:
    """Each is replayed once."""
    key = name, subject.sensors
    if key not in _FOUND:
        _FOUND[key] = outcome(subject, name, "medium")
    return _FOUND[key]


_FOUND: dict[tuple[str, str], Outcome] = {}


def test_drives_without_faults_are_within_limits_and_without_warnings(drives: dict[str, Subject]) -> None:
    for subject in drives.values():
        result, warned = fused(subject.log, (), subject)
        error, sigma = at_epochs(subject, result.states)
        assert warned == ()
        assert (np.abs(error[-1000:]) < subject.largest).all()
        assert np.nanmax(np.abs(error[-1000:]) / sigma[-1000:]) < 5.0
        moving = np.linalg.norm(subject.drive.truth.at(subject.epochs).vel_enu, axis=1)
        begin = round(subject.begin_s * 10)
        assert (moving[begin : begin + 90] > 4.9).all()


def pushed(subject: Subject, metres: float, first_s: float, last_s: float) -> Outcome:
    """The outcome of a result that lies so far to the left of the truth between two times after the fault's begin."""
    result, _ = fused(subject.log, (), subject)
    (one,) = parse([f"wheel-stuck:mild@{subject.begin_s}+10"])
    states = result.states
    s = (states.t_ns - subject.log.imu.t_ns[0]) * 1e-9 - subject.begin_s  # type: ignore[union-attr]
    row = np.searchsorted(subject.epochs, states.t_ns)
    yaw = subject.truth[1][row]
    offset = np.where((s >= first_s) & (s <= last_s), metres, 0.0)[:, None] * np.stack(
        (-np.sin(yaw), np.cos(yaw), 0.0 * yaw), axis=-1
    )
    states = replace(states, llh=displaced(states.llh, offset))
    return judged(subject, replace(result, states=states), (), one)


def test_outcomes_have_the_figures_of_errors_made_on_purpose(drives: dict[str, Subject]) -> None:
    subject = drives[ALL]
    nothing = pushed(subject, 0.0, 0.0, 0.0)
    assert (nothing.ar, nothing.recover_s, nothing.astray) == (1.0, 0.0, False)
    once = pushed(subject, 2.0, 12.0, 14.95)  # the fault is over after ten
    left = len(subject.epochs) - round(subject.begin_s * 10)
    assert once.ar == pytest.approx(1.0 - 30 / left, abs=1.5 / left)
    assert once.peak_horizontal_m == pytest.approx(2.0, abs=0.05)
    assert once.peak_sigmas > 50.0
    assert once.recover_s == pytest.approx(4.95, abs=0.1)
    assert once.silent
    during = pushed(subject, 2.0, 3.0, 9.9)
    assert during.recover_s == 0.0
    assert during.astray
    assert pushed(subject, 2.0, 30.0, 1e9).recover_s is None
    within = pushed(subject, 0.2, 3.0, 1e9)
    assert (within.ar, within.astray, within.recover_s) == (1.0, False, 0.0)


def cell(*outcomes: Outcome, name: str = "imu-spike") -> Cell:
    return Cell(name, "medium", ALL, list(outcomes))


GOOD = Outcome(1.0, 0.02, 0.03, 2.0, 0.0, False)


@pytest.mark.parametrize(
    ("outcome", "word"),
    [
        (GOOD, "ok"),
        (replace(GOOD, ar=0.99), "out, knows it"),
        (replace(GOOD, ar=0.9, astray=True, warned=("lost",)), "astray, says so"),
        (replace(GOOD, ar=0.1, recover_s=None, astray=True, warned=("lost",)), "lost, says so"),
        (replace(GOOD, ar=0.9, astray=True, untold_s=1.0), "astray, says so"),
        (replace(GOOD, ar=0.9, astray=True, untold_s=1.1), "SILENT"),
        (replace(GOOD, not_finite=3), "NOT FINITE"),
        (Outcome(crash="ValueError: no"), "CRASH"),
    ],
)
def test_a_cell_is_as_bad_as_its_worst_drive(outcome: Outcome, word: str) -> None:
    assert verdict(cell(GOOD, outcome)) == word


def test_reports_for_programs_and_for_pages() -> None:
    lost = replace(GOOD, ar=0.5, recover_s=None, astray=True, warned=("lost",))
    found = Matrix([cell(GOOD, replace(GOOD, ar=0.8)), cell(lost, name="imu-scale")], [7, 8], 240.0)
    rows = {(row["name"], row["metric"]): row for row in report(found)["rows"]}
    assert rows["imu-spike:medium, all sensors", "ar"]["median"] == 0.9
    assert rows["imu-spike:medium, all sensors", "ar"]["min"] == 0.8
    assert ("imu-scale:medium, all sensors", "recover_s") not in rows
    json.dumps(report(found), allow_nan=False)
    page = markdown(found)
    assert "| imu-spike:medium | one sample is 100 m/s^2 and 5 rad/s off on all axes | 80.0 |" in page
    assert "| never | lost, says so |" in page


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("replay.bench.faults.FAULTS", {name: FAULTS[name] for name in ("imu-spike", "pose-lane")})
    page = tmp_path / "page.md"
    assert main(["bench", "faults", "--short", "--seed", "1000", "--json", "--markdown", str(page)]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["bench"] == "faults"
    assert shown["conditions"]["seeds"] == [SEED]
    assert {row["name"] for row in shown["rows"]} == {
        *(f"imu-spike:medium, {sensors}" for sensors in SENSOR_SETS),
        "pose-lane:medium, all sensors",
    }
    assert page.read_text().count("| imu-spike:medium |") == 2
    assert main(["bench", "faults", "--drives", "0"]) == 2
