"""`egoloc bench consistency`: whether the filter knows how wrong it is, over many seeded drives and a long one.

NEES (Bar-Shalom 2001, sec. 5.4) of each block of the error state by the whole covariance, once a second. `per_dof`:
mean over drives and epochs, 1 for a filter that is right about itself, more where it is overconfident. `inside`: part
of the epochs whose mean over the drives lies in the two-sided 95 % interval, which only white errors that the filter is
told of can reach. `single`: part of all single values that lie in theirs.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from fusion.axes import with_lean
from fusion.config import FusionConfig
from fusion.navigator import Navigator
from fusion.sensor_models import GnssModel, ImuNoise, MotionModel, PoseModel
from fusion.state import (
    ACCEL_BIAS,
    C_STATE,
    E_ACCEL_BIAS,
    E_ATTITUDE,
    E_GYRO_BIAS,
    E_POSITION,
    E_VELOCITY,
    GYRO_BIAS,
    LLH,
    QUATERNION,
    VELOCITY,
)
from fusion.timeline import parameters
from replay.bench.measure import conditions, row
from replay.table import bare_table
from sensors.clock import NS_PER_S
from sensors.geodesy import enu_from_llh
from sensors.simulate.drive import Drive, DriveConfig, simulate_drive, simulate_pieces
from sensors.simulate.environment import Environment, Landmarks, Sky
from sensors.simulate.imu import ImuSimulation
from sensors.simulate.scenarios import load

Floats = NDArray[np.float64]
Watch = Callable[[str], None]

ESTIMATED = 15
"""States whose truth the simulator knows: position to accelerometer bias."""
_EVERY = np.arange(ESTIMATED)
BLOCKS: Mapping[str, NDArray[np.intp]] = {
    "position": _EVERY[E_POSITION],
    "velocity": _EVERY[E_VELOCITY],
    "attitude": _EVERY[E_ATTITUDE],
    "gyro bias": _EVERY[E_GYRO_BIAS],
    "accelerometer bias": _EVERY[E_ACCEL_BIAS],
    "pose": np.concatenate((_EVERY[E_POSITION], _EVERY[E_ATTITUDE])),
    "horizontal pose": np.array([0, 1, 8]),
}
FIRST_SEED = 5000
INTERVAL = (0.025, 0.975)
DAY_STEP_S = 10.0
"""How often P is looked at on the long drive, s."""

AS_DRAWN = FusionConfig(
    imu=ImuNoise(noise_scale=1.0),
    gnss=GnssModel(
        white_share=1.0,
        lasting_share=0.0,
        sigma_floor_horizontal_m=0.0,
        sigma_floor_vertical_m=0.0,
        sigma_floor_velocity=0.0,
    ),
    pose=PoseModel(
        white_share=1.0, lasting_share=0.0, yaw_offset_sigma_deg=0.0, sigma_floor_m=0.0, sigma_floor_yaw_deg=0.0
    ),
    motion=MotionModel(zero_velocity=False, non_holonomic=False),
)
"""The white noise as the simulator draws it: no floors, and nothing beside the sensors (the simulated vehicle keeps to
the constraint exactly, which no stated sigma would say)."""
AS_LASTING = msgspec.structs.replace(
    AS_DRAWN,
    gnss=msgspec.structs.replace(AS_DRAWN.gnss, white_share=0.2, lasting_share=0.8, lasting_s=30.0),
    pose=msgspec.structs.replace(
        AS_DRAWN.pose, white_share=0.2, lasting_share=0.8, lasting_m=300.0, yaw_offset_sigma_deg=0.108
    ),
)
"""The same of errors four fifths of whose variance lasts."""


@dataclass(frozen=True)
class Case:
    """Drives of duration_s of a scenario, and how they are filtered (None: by the given or the default config)."""

    name: str
    scenario: DriveConfig
    duration_s: float
    config: FusionConfig | None = None


def cases() -> tuple[Case, ...]:
    """White errors and errors that last, which the filter is told of; the latter, as it takes them by default; and
    everything that goes wrong on the road."""
    road = load("road-test")
    return (
        Case("white", load("clean"), 100.0, AS_DRAWN),
        Case("lasting errors", lasting_errors(road), 200.0, AS_LASTING),
        Case("lasting errors, by default", lasting_errors(road), 200.0),
        Case("road-test", road, 200.0),
    )


def lasting_errors(road: DriveConfig) -> DriveConfig:
    """road-test without its events, flaws, warm-up and vibration: only that GNSS errors last 30 s, those of pose fixes
    300 m (four fifths of the variance), and the yaw offset of the camera."""
    quiet = {name: _without_events(environment) for name, environment in road.environments.items()}
    gnss = msgspec.structs.replace(road.gnss, float_per_hour=0.0, lost_per_hour=0.0, wrong_fix_per_hour=0.0)
    pose = msgspec.structs.replace(road.pose_fix, gross_per_hour=0.0, dropped_fraction=0.0, burst_per_hour=0.0)
    wheel = msgspec.structs.replace(road.wheel, drift_sigma=0.0, quantum=0.0, slip_per_accel=0.0)
    return msgspec.structs.replace(
        road, environments=quiet, gnss=gnss, pose_fix=pose, wheel=wheel, imu=ImuSimulation(), length_km=None
    )


def _without_events(environment: Environment) -> Environment:
    landmarks = Landmarks(scarcity=environment.landmarks.scarcity)
    return msgspec.structs.replace(environment, sky=Sky(), landmarks=landmarks)


def run(
    seeds: int = 200, hours: float = 24.0, config: FusionConfig | None = None, watch: Watch | None = None
) -> dict[str, Any]:
    """NEES of every case over so many drives, then P over so many hours.

    config: in place of the default for what is not white; watch: hears what is being done.
    """
    tell = watch or (lambda _: None)
    rows: list[dict[str, Any]] = []
    for case in cases():
        scores = case_scores(case, seeds, config, tell)
        rows += [each for block, values in scores.items() for each in _rows(case.name, block, values)]
    if hours > 0:
        asymmetry, ratio = health_over(hours, config or FusionConfig(), tell)
        rows += [row(f"{hours:g} h", "largest asymmetry", asymmetry), row(f"{hours:g} h", "eigenvalue ratio", ratio)]
    facts = {"seeds": seeds, "first_seed": FIRST_SEED, "hours": hours, "epochs_hz": 1}
    return {"bench": "consistency", "rows": rows, "ratios": {}, "conditions": conditions(["numba", "numpy"], **facts)}


def case_scores(case: Case, seeds: int, config: FusionConfig | None, tell: Watch) -> dict[str, Floats]:
    """Block -> (seeds, epochs) NEES, NaN before the first state."""
    filtered = case.config or config or FusionConfig()
    found = []
    for number in range(seeds):
        tell(f"{case.name}: drive {number + 1} of {seeds}")
        drive = simulate_drive(case.duration_s, FIRST_SEED + number, case.scenario)
        found.append(nees(drive, filtered))
    return {block: np.array([scores[block] for scores in found]) for block in BLOCKS}


def nees(drive: Drive, config: FusionConfig) -> dict[str, Floats]:
    """Block -> (E,) NEES at every full second of a drive, NaN before the first state."""
    log = drive.log
    assert log.imu is not None
    seconds = np.arange(-(-int(log.imu.t_ns[0]) // NS_PER_S), int(log.imu.t_ns[-1]) // NS_PER_S + 1)
    epochs = seconds * NS_PER_S
    navigator = Navigator(log.vehicle, log.map_frame, config)
    navigator.add(log)
    axes_var = parameters(log.vehicle, config).axes_var
    states = [_state_at(navigator, int(t_ns), axes_var) for t_ns in epochs]
    scores = {block: np.full(len(epochs), np.nan) for block in BLOCKS}
    known = np.array([state is not None for state in states])
    if not known.any():
        return scores
    nav, P = (np.array(part) for part in zip(*(state for state in states if state is not None), strict=True))
    error = _errors(drive, epochs[known], nav)
    for block, members in BLOCKS.items():
        within = P[:, members[:, None], members]
        off = error[:, members]
        scores[block][known] = np.einsum("ni,ni->n", off, np.linalg.solve(within, off[..., None])[..., 0])
    return scores


def _state_at(navigator: Navigator, t_ns: int, axes_var: float) -> tuple[Floats, Floats] | None:
    """nav and P, as it is stated, after everything up to a time on the output grid; None: not aligned."""
    navigator.advance(t_ns)
    navigator.take_states()
    core = navigator.core
    if core is None or core.clock[C_STATE] != t_ns:
        return None
    assert core.span[0] == 0.0  # P belongs to the state
    return core.nav.copy(), with_lean(core.P, core.nav, axes_var)


def _errors(drive: Drive, t_ns: NDArray[np.int64], nav: Floats) -> Floats:
    """(N, 15) true minus estimated, in the order and axes of the error state."""
    motion, imu, biases = drive.truth.at(t_ns), drive.log.imu, drive.imu_biases
    assert imu is not None
    at = np.searchsorted(imu.t_ns, t_ns)
    datum = nav[0, LLH]
    turn = Rotation.from_quat(motion.q_enu_body) * Rotation.from_quat(nav[:, QUATERNION]).inv()
    return np.hstack(
        (
            enu_from_llh(motion.llh, datum) - enu_from_llh(nav[:, LLH], datum),
            motion.vel_enu - nav[:, VELOCITY],
            turn.as_rotvec(),
            biases.gyro[at] - nav[:, GYRO_BIAS],
            biases.accel[at] - nav[:, ACCEL_BIAS],
        )
    )


def _rows(case: str, block: str, scores: Floats) -> Iterator[dict[str, Any]]:
    """The lines of one block: min and max are over drives."""
    dof = len(BLOCKS[block])
    name = f"{case}: {block}"
    enough = np.isfinite(scores).sum(axis=0) >= (len(scores) + 1) // 2
    drives = np.isfinite(scores).any(axis=1)
    each = np.nanmean(scores[drives], axis=1) / dof
    yield {**row(name, "per_dof", each), "median": float(np.nanmean(scores) / dof)}
    yield row(name, "inside", [inside(scores[:, enough], dof)])
    low, high = (_chi_square(p, dof) for p in INTERVAL)
    known = scores[np.isfinite(scores)]
    yield row(name, "single", [float(((known > low) & (known < high)).mean())])


def inside(scores: Floats, dof: int) -> float:
    """Part of the epochs whose mean over the drives (D, E; NaN: none) lies in the two-sided 95 % interval."""
    count = np.isfinite(scores).sum(axis=0)
    low, high = (_chi_square(p, dof * count) for p in INTERVAL)
    total = np.nansum(scores, axis=0)
    return float(((total > low) & (total < high)).mean())


def _chi_square(probability: float, dof: Any) -> Any:
    return 2.0 * gammaincinv(np.asarray(dof) / 2.0, probability)


def table(result: Mapping[str, Any]) -> Table:
    """One line for each block: NEES over degrees of freedom with its least and largest drive, then the shares."""
    shown = bare_table(2)
    for header in ("drives: block", "NEES/dof", "least", "largest", "inside %", "single %"):
        shown.add_column(header, justify="left" if header.startswith("drives") else "right", no_wrap=True)
    by_name: dict[str, dict[str, Any]] = {}
    for each in result["rows"]:
        by_name.setdefault(each["name"], {})[each["metric"]] = each
    for name, found in by_name.items():
        if "per_dof" in found:
            mean = found["per_dof"]
            shares = (f"{100 * found[metric]['median']:.1f}" for metric in ("inside", "single"))
            shown.add_row(name, *(f"{mean[key]:.2f}" for key in ("median", "min", "max")), *shares)
        else:
            for metric, each in found.items():
                shown.add_row(
                    f"{name}: P, {metric}", f"{each['median']:.2g}", f"{each['min']:.2g}", f"{each['max']:.2g}"
                )
    return shown


def health_over(hours: float, config: FusionConfig, tell: Watch) -> tuple[list[float], list[float]]:
    """Asymmetry and least-to-largest eigenvalue of P, every DAY_STEP_S of a long drive of the demo.

    Both of the correlation matrix, so that units do not matter; states without variance are left out.
    """
    scenario = load("demo")
    asymmetry, ratio = [], []
    navigator = None
    for piece in simulate_pieces(hours * 3600.0, scenario.seed, scenario):
        assert piece.imu is not None
        tell(f"{hours:g} h: {(int(piece.imu.t_ns[0]) / NS_PER_S - scenario.start.unix_s) / 3600.0:.1f} h")
        navigator = navigator or Navigator(piece.vehicle, piece.map_frame, config)
        navigator.add(piece)
        last = int(piece.imu.t_ns[-1])
        for t_ns in range(int(piece.imu.t_ns[0]), last + 1, round(DAY_STEP_S * NS_PER_S)):
            navigator.advance(t_ns)
            navigator.take_states()
            navigator.take_decisions()
            if navigator.core is not None:
                off, least = health_of(navigator.core.P)
                asymmetry.append(off)
                ratio.append(least)
        navigator.advance(last)
    return asymmetry, ratio


def health_of(P: Floats) -> tuple[float, float]:
    """Largest |P - P'| and least eigenvalue over the largest one, of the correlation matrix; NaN where it has none."""
    used = np.diag(P) != 0.0
    P = P[np.ix_(used, used)]
    if not (np.isfinite(P).all() and (np.diag(P) > 0).all()):
        return float("nan"), float("nan")
    scale = 1.0 / np.sqrt(np.diag(P))
    correlation = P * np.outer(scale, scale)
    values = np.linalg.eigvalsh((correlation + correlation.T) / 2.0)
    return float(np.abs(correlation - correlation.T).max()), float(values[0] / values[-1])
