"""GNSS-RTK alone and EgoVM alone on a scenario, against the truth: the rows that road-test is set by.

    python -m tests.sensors.simulate.sensor_rows [--scenario road-test] [--drives 100] [--seed 100000] [--network 0 ...]

No filter runs here. Definitions are those of docs/metrics.md: a fix stands for the time back to the one before it, 1.5
periods at most; AR counts all time from the reference's start on, MAE and RMSE the fixes.
"""

import argparse
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.geodesy import map_from_llh
from sensors.rotation import wrap
from sensors.simulate.drive import DriveConfig, plan, simulated
from sensors.simulate.reference import yaw_in_map
from sensors.simulate.scenarios import load

Floats = NDArray[np.float64]

LIMITS = (0.6, 0.3, math.radians(1.0))
THRESHOLDS = ((0.1, 0.2, 0.3), (0.1, 0.2, 0.3), tuple(math.radians(d) for d in (0.1, 0.3, 0.6)))
AXES = ("lon", "lat", "yaw")
PAPER: dict[str, dict[str, Any]] = {
    "gnss": {"ar": 93.67, "lon": (0.132, 1.082, 91.41, 93.33, 94.12), "lat": (0.122, 0.950, 91.26, 93.63, 94.54)},
    "egovm": {
        "ar": 99.82,
        "lon": (0.037, 0.104, 96.99, 99.66, 99.77),
        "lat": (0.026, 0.035, 98.54, 99.93, 99.99),
        "yaw": (0.131, 0.506, 42.49, 96.29, 99.75),
    },
}
"""Table 5: AR %, then MAE, RMSE (m, m, deg) and the shares below the thresholds, %."""


@dataclass
class Row:
    """Sums of one method over drives."""

    good_ns: float = 0.0
    covered_ns: float = 0.0
    total_ns: float = 0.0
    sizes: list[Floats] = field(default_factory=list)

    def add(self, t_ns: NDArray[np.int64], error: Floats, begin_ns: int, end_ns: int) -> None:
        """error: (N, axes) along, left (m) and in yaw (rad) at t_ns (N,), of which those in ]begin, end] are judged."""
        period = float(np.median(np.diff(t_ns)))
        time = np.minimum(np.diff(t_ns, prepend=t_ns[0]), 1.5 * period)
        time = np.minimum(time, np.maximum(t_ns - begin_ns, 0)) * (t_ns <= end_ns)
        scored, size = time > 0, np.abs(error)
        good = (size < LIMITS[: error.shape[1]]).all(axis=1)
        self.total_ns += end_ns - begin_ns
        self.covered_ns += time.sum()
        self.good_ns += time[good].sum()
        self.sizes.append(size[scored])

    def result(self) -> dict[str, Any]:
        size = np.concatenate(self.sizes)
        found: dict[str, Any] = {
            "ar": 100 * self.good_ns / self.total_ns,
            "coverage": 100 * self.covered_ns / self.total_ns,
        }
        for axis, column in enumerate(size.T):
            unit = 1.0 if axis < 2 else math.degrees(1.0)
            below = (100 * float(np.mean(column < t)) for t in THRESHOLDS[axis])
            found[AXES[axis]] = (unit * column.mean(), unit * math.sqrt(np.mean(column**2)), *below)
        return found


def rows(
    config: DriveConfig, seeds: range, networks: Sequence[int]
) -> tuple[dict[str, dict[str, Any]], dict[str, float]]:
    """Both rows, and kilometres by scene tag, over drives of these seeds, on each of the networks in turn."""
    fleet = [msgspec.structs.replace(config, network_seed=network) for network in networks]
    gnss, egovm, km = Row(), Row(), Counter[str]()
    for index, seed in enumerate(seeds):
        config = fleet[index % len(fleet)]
        planned = plan(None, seed, config)
        truth, course = planned.truth, planned.course
        begin = truth.start_ns + round(config.reference.start_s * 1e9)
        end = truth.start_ns + round(planned.duration_s * 1e9)
        drive = simulated(planned, seed, config)
        log, frame = drive.log, drive.log.map_frame
        assert log.gnss is not None
        assert log.pose_fixes is not None
        assert frame is not None
        for row, record, arm, p_map in (
            (gnss, log.gnss, log.vehicle.gnss_lever_arm, map_from_llh(frame, log.gnss.llh)),
            (egovm, log.pose_fixes, log.vehicle.pose_lever_arm, log.pose_fixes.pose),
        ):
            motion = truth.at(record.t_ns)
            yaw = yaw_in_map(motion, frame)
            d = p_map[:, :2] - map_from_llh(frame, motion.place_of(arm))[:, :2]
            c, s = np.cos(yaw), np.sin(yaw)
            error = [c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]]
            if row is egovm:
                error.append(wrap(log.pose_fixes.pose[:, 2] - yaw))
            row.add(record.t_ns, np.stack(error, axis=-1), begin, end)
        for first, last, kind in zip(course.edges[:-1], course.edges[1:], course.kind, strict=True):
            km[course.names[kind]] += max(min(last, course.s[-1]) - first, 0.0) / 1000
    return {"gnss": gnss.result(), "egovm": egovm.result()}, dict(km)


def show(found: dict[str, dict[str, Any]]) -> None:
    """Print each row above the paper's."""
    for method, row in found.items():
        print(f"{method:6} AR {row['ar']:6.2f} % (paper {PAPER[method]['ar']:.2f}), coverage {row['coverage']:.2f} %")
        for axis in AXES:
            if axis in row:
                for name, values in (("", row[axis]), ("paper", PAPER[method][axis])):
                    mae, rmse, *below = values
                    shares = " ".join(f"{share:6.2f}" for share in below)
                    print(f"  {axis} {name:6} MAE {mae:.4f} RMSE {rmse:.4f}  below {shares}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="road-test")
    parser.add_argument("--drives", type=int, default=100)
    parser.add_argument("--seed", type=int, default=100_000)
    parser.add_argument(
        "--network", type=int, nargs="+", default=[0], help="seeds of roads; the scenario's own are for reports"
    )
    given = parser.parse_args()
    found, km = rows(load(given.scenario), range(given.seed, given.seed + given.drives), given.network)
    show(found)
    print("  ".join(f"{name} {length:.1f} km" for name, length in sorted(km.items())))


if __name__ == "__main__":
    main()
