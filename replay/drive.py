"""One drive on its way through the filter, piece by piece, and what is known of it at its end."""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from fusion.result import Estimated, FusionResult, States
from fusion.run import Session
from replay.calibration import estimate_facts
from replay.config import RunConfig
from replay.evaluation import Batch, Evaluation
from replay.plausibility import FASTEST_SPEED, Watch
from replay.references import Samples
from replay.requirements import Contents, check_replayable
from replay.run_files import Facts
from replay.smoothing import Columns, Smoothing
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, utm_frame
from sensors.records import LeftOut, Log, Trajectory
from sensors.simulate.faults.spec import Injection
from sensors.vehicle import Vehicle


class Drive:
    """Pieces in, batches of rows out.

    first: the first piece, which tells vehicle and map frame where the config does not; where: how messages about the
    drive begin; reference_file: a trajectory instead of the drive's reference; faults: what was put into the pieces;
    all_columns: of decisions, not only those that scoring reads; scratch: folder for what is kept in files until the
    drive is smoothed. config: with the vehicle and the map frame in use (a drive without one takes the UTM frame of its
    first fix, unless it holds map coordinates); km: how far the filter has driven.
    """

    def __init__(
        self,
        first: Log,
        config: RunConfig,
        where: str,
        reference_file: Path | None = None,
        faults: Sequence[Injection] = (),
        *,
        all_columns: bool = True,
        scratch: Path | None = None,
    ) -> None:
        vehicle, frame = config.vehicle or first.vehicle, config.map_frame or first.map_frame
        self._trajectory: Trajectory | None = None
        if reference_file is not None:
            self._trajectory, frame = read_reference(reference_file, frame, vehicle)
        self._source = "log" if reference_file is None else reference_file.name
        self.config = msgspec.structs.replace(config, vehicle=vehicle, map_frame=frame)
        self.period_ns, self.km = round(NS_PER_S / config.fusion.output_hz), 0.0
        self._vehicle, self._where, self._faults = vehicle, where, faults
        with self._named():
            self._smoothing = Smoothing(scratch) if config.smooth else None
            tape = None if self._smoothing is None else self._smoothing.tape
            self._session = Session(vehicle, frame, config.fusion, tape)
            self._evaluation = Evaluation(vehicle, config, self._trajectory, all_columns=all_columns)
        self._watch, self._contents = Watch(land_vehicle=vehicle.land_vehicle), Contents()
        self._left_out, self._noted = Counter[tuple[str, str]](), Counter[tuple[str, str]]()
        self._aligned_ns: int | None = None
        self._estimates: tuple[Estimated, ...] = ()

    def push(self, piece: Log) -> Batch:
        """The next piece (the first comes again). Raises EgolocError where it cannot be used."""
        self._contents.add(piece)
        _count(self._left_out, piece.left_out)
        with self._named():
            given = self._evaluation.given(self._placed(piece))
            result = self._session.push(given)
            self._see(given, result)
            return self._noticed(self._evaluation.add(given, result))

    def finish(self) -> Batch:
        """The rest. Raises EgolocError where the drive lacked what a replay needs."""
        with self._named():
            check_replayable(self._contents, _entries(self._left_out))
            result = self._session.finish()
            self._see(Log(), result)
            return self._noticed(self._evaluation.finish(result))

    def smoothed(self) -> Iterator[Columns]:
        """Rows of the smoothed states after the end, in the order of time; none where it is not smoothed."""

        def compare(states: States, samples: Samples) -> Columns:
            with self._named():
                return self._evaluation.compared(states, samples)

        return iter(()) if self._smoothing is None else self._smoothing.rows(compare)

    def _noticed(self, batch: Batch) -> Batch:
        if self._smoothing is not None:
            self._smoothing.add(batch)
        return batch

    @property
    def start_ns(self) -> int | None:
        """Stamp of the first IMU sample, once it has come."""
        return self._evaluation.first_imu_ns

    def facts(self) -> Facts:
        """What scoring must know besides the tables, at the end."""
        start_ns = self.start_ns
        assert start_ns is not None
        hide = self.config.hide_gnss
        return {
            "order": self.config.fusion.order,
            "period_ns": self.period_ns,
            "start_ns": start_ns,
            "alignment_s": None if self._aligned_ns is None else (self._aligned_ns - start_ns) / NS_PER_S,
            "reference": self._evaluation.reference_facts(self._source),
            "hide_gnss": None if hide is None else msgspec.to_builtins(hide),
            "stretches": self._evaluation.stretches,
            "health": self._watch.health.counts(self._evaluation.epochs()),
            "warnings": [*injected(self._faults), *self._watch.findings(start_ns)],
            "left_out": [
                {"source": entry.source, "reason": entry.reason, "count": entry.count}
                for entry in (*_entries(self._left_out), *_entries(self._noted))
            ],
            "smoothed": self._smoothing is not None,
            "estimates": estimate_facts(self._estimates),
        }

    def _placed(self, piece: Log) -> Log:
        """A piece with the vehicle, map frame and reference in use."""
        if self._trajectory is not None:
            piece = replace(piece, reference=None)
        frame = self.config.map_frame
        if frame is None:
            frame = _own_frame(piece, has_reference=self._trajectory is not None)
            self.config = msgspec.structs.replace(self.config, map_frame=frame)
        return replace(piece, vehicle=self._vehicle, map_frame=frame)

    def _see(self, given: Log, result: FusionResult) -> None:
        self._watch.add(given, result)
        _count(self._noted, result.left_out)
        self._aligned_ns, self._estimates = result.aligned_ns, result.estimates
        speed = np.hypot(result.states.vel_enu[:, 0], result.states.vel_enu[:, 1])
        self.km += float(speed[speed < FASTEST_SPEED].sum()) * self.period_ns / NS_PER_S / 1000.0

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Errors begin with the drive's name; what is not finite is said in warnings, not by numpy."""
        try:
            with np.errstate(all="ignore"):
                yield
        except EgolocError as error:
            raise EgolocError(f"{self._where}: {error}") from None


def injected(faults: Sequence[Injection]) -> Iterator[dict[str, str]]:
    """A warning for each fault that was put in: what comes of it is no measure of the drive."""
    for one in faults:
        span = f"from {one.begin_s:g} s on for {one.length_s:g} s"
        yield {"kind": "injected", "text": f"Fault injected, {span}: {one.fault.name}: {one.told}."}


def read_reference(path: Path, frame: MapFrame | None, vehicle: Vehicle) -> tuple[Trajectory, MapFrame | None]:
    """A trajectory file in a frame or, where none is known, in that of the file.

    It tells of the vehicle's reference point, but for the states of a run, which are of the body and brought there.
    """
    from sensors.datasets.run_trajectory import is_parquet, read_run_trajectory
    from sensors.datasets.trajectory_file import read_trajectory

    if is_parquet(path):
        return read_run_trajectory(path, frame, vehicle.reference_lever_arm)
    return read_trajectory(path, frame)


def _own_frame(piece: Log, *, has_reference: bool) -> MapFrame | None:
    """The UTM frame of the first fix; None: there is no fix yet. Raises where map coordinates came without a frame."""
    reference = has_reference or piece.reference is not None
    mapped = [name for name, has in (("pose fixes", piece.pose_fixes is not None), ("a reference", reference)) if has]
    if mapped:
        raise EgolocError(
            f"{' and '.join(mapped)} in map coordinates: expected a map frame in the log or [map_frame] in the config"
        )
    if piece.gnss is None or not len(piece.gnss):
        return None
    try:
        return utm_frame(piece.gnss.llh[0])
    except EgolocError as error:
        raise EgolocError(f"{error}: expected [map_frame] in the config") from None


def _count(counts: Counter[tuple[str, str]], left_out: Sequence[LeftOut]) -> None:
    for entry in left_out:
        counts[entry.source, entry.reason] += entry.count


def _entries(counts: Counter[tuple[str, str]]) -> list[LeftOut]:
    return [LeftOut(source, reason, count) for (source, reason), count in counts.items()]
