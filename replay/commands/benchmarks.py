"""egoloc bench: all benchmarks by name."""

from replay.commands.bench_maps import BenchImports, BenchLidar, BenchMaps
from replay.commands.bench_network import BenchNetwork, BenchSolver
from replay.commands.benching import (
    BenchConsistency,
    BenchFaults,
    BenchFilter,
    BenchGates,
    BenchHidden,
    BenchLive,
    BenchMcap,
    BenchReplay,
)

BENCHMARKS = {
    "filter": BenchFilter,
    "live": BenchLive,
    "replay": BenchReplay,
    "mcap": BenchMcap,
    "maps": BenchMaps,
    "imports": BenchImports,
    "lidar": BenchLidar,
    "solver": BenchSolver,
    "network": BenchNetwork,
    "gates": BenchGates,
    "faults": BenchFaults,
    "hidden": BenchHidden,
    "consistency": BenchConsistency,
}
