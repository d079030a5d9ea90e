"""How a filter did over a drive: epochs by state of health and cause, and the stretches over which it had diverged."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion.health import SOURCES
from fusion.result import Cause, FusionResult, Health, Restart, States

LEVELS = tuple(f"{sensor.name.lower()}_level" for sensor in SOURCES)
"""Columns of states.parquet with the level of each sensor."""
RESTARTS = "restarts"
_NAMED = {Health.DEGRADED: "degraded_by", Health.DIVERGED: "diverged_by"}
"""States whose causes are counted, and their keys in metrics.json."""


@dataclass(slots=True)
class Stretches:
    """Epochs with one cause: how many, in how many stretches, and the ends of the first, ns."""

    epochs: int = 0
    count: int = 0
    start_ns: int = 0
    end_ns: int = 0


class Tally:
    """Counts a drive piece by piece."""

    def __init__(self) -> None:
        self._pairs = np.zeros((len(Health), len(Cause)), np.int64)
        self._told: dict[Cause, Stretches] = {}
        self._last = 0
        self.restarts: list[Restart] = []

    def add(self, result: FusionResult) -> None:
        """What was decided with the next piece."""
        states = result.states
        pairs = states.health.astype(np.int64) * len(Cause) + states.cause
        self._pairs += np.bincount(pairs, minlength=self._pairs.size).reshape(self._pairs.shape)
        self.restarts += result.restarts
        if len(states):
            self._add_told(states)

    @property
    def told(self) -> Mapping[Cause, Stretches]:
        """Stretches of divergence, and of a filter not settled, by cause, in the order of their first."""
        return self._told

    def counts(self, epochs: int) -> dict[str, int]:
        """Epochs by state, those with a cause as "state/cause", and restarts; epochs: of the whole drive."""
        counts = {Health.INITIALIZING.name.lower(): epochs - int(self._pairs.sum())}
        for health in Health:
            for cause in Cause:
                if self._pairs[health, cause]:
                    named = f"/{cause.name.lower()}" if cause else ""
                    counts[health.name.lower() + named] = int(self._pairs[health, cause])
        return counts | {RESTARTS: len(self.restarts)}

    def _add_told(self, states: States) -> None:
        """Stretches go on over the edge of a piece."""
        counts = (states.health == Health.DIVERGED) | (states.cause == Cause.UNSETTLED)
        codes = np.where(counts, states.cause, 0)
        first = np.flatnonzero(np.diff(codes, prepend=self._last))
        edges = np.unique(np.r_[0, first, len(codes)])
        for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            cause = Cause(int(codes[begin]))
            if cause is Cause.NONE:
                continue
            stretch = self._told.setdefault(cause, Stretches(start_ns=int(states.t_ns[begin])))
            stretch.epochs += end - begin
            stretch.count += int(begin in first)
            if stretch.count == 1:
                stretch.end_ns = int(states.t_ns[end - 1])
        self._last = int(codes[-1])


def health_metrics(counts: Mapping[str, int]) -> dict[str, Any]:
    """The entry of metrics.json: the share of time in each state, and in each cause of those that have one."""
    pairs = {(*key.split("/"), "")[:2]: count for key, count in counts.items() if key != RESTARTS}
    total = sum(pairs.values())
    if not total:
        return {}
    shares: dict[str, Any] = {}
    for health in Health:
        of = {cause: count for (name, cause), count in pairs.items() if name == health.name.lower()}
        shares[health.name.lower()] = sum(of.values()) / total
        if health in _NAMED:
            shares[_NAMED[health]] = {cause: count / total for cause, count in of.items()}
    return {**shares, RESTARTS: counts.get(RESTARTS, 0)}


def health_note(health: Mapping[str, Any]) -> str:
    """One line on the shares of time, in %."""
    parts = []
    for name in (state.name.lower() for state in Health):
        share = health[name]
        if not share:
            continue
        causes = health.get(f"{name}_by", {})
        most = sorted(causes, key=lambda cause: (-causes[cause], cause))
        listed = ", ".join(f"{cause.replace('_', ' ')} {100 * causes[cause]:.1f}" for cause in most)
        parts.append(f"{name.replace('_', ' ')} {100 * share:.1f}" + (f" ({listed})" if listed else ""))
    started = health[RESTARTS]
    again = f"; started again {started} times" if started > 1 else "; started again once" if started else ""
    return f"Health, % of time: {', '.join(parts)}{again}."
