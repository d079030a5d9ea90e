"""`egoloc bench lidar`: sweeps of the simulated LiDAR in made-up streets: time, what rays meet, the cost of the world.

Places are spread over the drive of the scenario survey. `street`: making a kilometre of street, once; `scene`: sorting
what lies around a place whose streets are made (a drive does it every 60 m); `sweep`: poses, rays and noise of a turn.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from replay.bench.measure import conditions, row
from sensors.clock import NS_PER_S
from sensors.simulate.drive import plan
from sensors.simulate.lidar import SCENE_REACH_M, beams, column_times, poses, sweep
from sensors.simulate.lidar_config import LidarSimulation
from sensors.simulate.scenarios import load
from sensors.simulate.scene import FIRST, GROUND, NOTHING, Hits, Scene
from sensors.simulate.surroundings import drive_world
from sensors.simulate.trajectory import Truth
from sensors.simulate.world import World

STANDS = 0.2
"""Share of the drive, from its start, that is left out: a vehicle stands before it drives."""


def run(repeats: int = 3, sweeps: int = 20) -> dict[str, Any]:
    """Figures of so many sweeps; of each the least time of the repeats, then the median over the places."""
    scenario = load("survey")
    planned = plan(scenario.duration_s, scenario.seed, scenario)
    world = drive_world(planned, scenario)
    street_ms = _streets(world)
    shares = np.linspace(STANDS, 0.95, sweeps)
    begins = planned.truth.start_ns + np.rint(shares * planned.duration_s * NS_PER_S).astype(np.int64)
    places = [_Place(world, planned.truth, int(begin), scenario.lidar) for begin in begins]
    met = [place.met() for place in places]
    rows = [
        row("street", "ms_per_km", street_ms),
        *(row(name, "ms", [place.least_ms(name, repeats) for place in places]) for name in _Place.TIMED),
        row("points", "count", [float(place.sweep()) for place in places]),
        *(row(f"rays that meet {name}", "share", [shares[name] for shares in met]) for name in met[0]),
    ]
    facts = {"rays": scenario.lidar.columns * 40, "sweeps": sweeps, "repeats": repeats}
    return {"bench": "lidar", "rows": rows, "ratios": {}, "conditions": conditions(["numpy", "numba"], **facts)}


class _Place:
    """Where and when a turn begins; what is timed there, by name."""

    TIMED = ("scene", "poses", "cast", "sweep")

    def __init__(self, world: World, truth: Truth, begin_ns: int, config: LidarSimulation) -> None:
        self._world, self._truth, self._config = world, truth, config
        self._t_ns: NDArray[np.int64] = begin_ns + column_times(config)
        self._poses = self.poses()
        self._scene = self.scene()

    def scene(self) -> Scene:
        return self._world.scene(self._poses[0][0, :2], self._config.range_max_m + SCENE_REACH_M)

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return poses(self._truth, self._world.frame, self._t_ns)

    def cast(self) -> Hits:
        p_map, R = self._poses
        origins = p_map + R @ np.array(self._config.place)
        return self._scene.cast(origins, R, beams(self._config.columns), self._config.range_max_m)

    def sweep(self) -> int:
        """Number of points."""
        return len(sweep(self._scene, *self.poses(), self._config, np.random.default_rng(0)))

    def least_ms(self, name: str, repeats: int) -> float:
        return min(_ms(getattr(self, name)) for _ in range(repeats))

    def met(self) -> dict[str, float]:
        """Shares of the rays by what they meet first."""
        what = self.cast().what
        plates = FIRST + len(self._scene.plates)
        posts = plates + len(self._scene.solids.posts)
        return {
            "nothing": float((what == NOTHING).mean()),
            "ground": float((what == GROUND).mean()),
            "walls, curbs, sidewalks, cars, signs": float(((what >= FIRST) & (what < plates)).mean()),
            "poles and trunks": float(((what >= plates) & (what < posts)).mean()),
            "crowns": float((what >= posts).mean()),
        }


def _streets(world: World) -> list[float]:
    """ms a kilometre of making each street, once."""
    km = np.diff(world.network.line) / 1000.0
    world.street(0)
    return [_ms(partial(world.street, edge)) / float(km[edge]) for edge in range(1, len(km))]


def _ms(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return 1000.0 * (time.perf_counter() - start)
