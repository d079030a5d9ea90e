"""`egoloc noise`: how noisy a run's GNSS and pose fixes are, from its decisions and from filtering its log again."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fusion.adaptive import NoiseEstimate, estimate
from fusion.innovations import AxisInnovations, consistency
from fusion.result import Decisions, Reason, Sensor
from replay.config import RunConfig, load_config
from replay.run_files import EXPECTED, checked, read_json, read_table
from replay.sources import LogSource, McapSource, parse
from replay.store import Keep, file_hash
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.pieces import SENSORS, join
from sensors.records import Log

COLUMNS = (
    "t_ns",
    "sensor",
    "reason",
    *(f"{name}_{i}" for name in ("innovation", "innovation_sigma") for i in range(3)),
)


@dataclass(frozen=True, slots=True, eq=False)
class RunNoise:
    """innovations: as the run left them; found: None where its log is not there (missing says why)."""

    run: Path
    innovations: tuple[AxisInnovations, ...]
    found: NoiseEstimate | None
    missing: str


def noise_of_run(folder: Path, log: str | None, duration_s: float, tell: Callable[[str], None]) -> RunNoise:
    """What the run's decisions say, and the noise that makes its log most likely.

    log: in place of the one that the manifest names; duration_s: of it is filtered, from its start.
    """
    if not folder.is_dir():
        raise EgolocError(f"{folder}: {EXPECTED}")
    if not duration_s > 0:
        raise EgolocError(f"--duration-s: expected more than 0, got {duration_s:g}")
    manifest = folder / "manifest.json"
    if checked(read_json(manifest).get("keep", {}), Keep, manifest).decisions != "all":
        raise EgolocError(f"{folder}: expected a run with all decisions, got one made with --decisions: replay the log")
    innovations = consistency(read_decisions(folder / "decisions.parquet"))
    config = load_config(folder / "config.toml")
    try:
        source = _source_of(folder) if log is None else parse(log)[0]
    except MissingLogError as error:
        return RunNoise(folder, innovations, None, str(error))
    tell("reading the log")
    whole = beginning(source, config, duration_s)
    try:
        found = estimate(whole, config.fusion, tell)
    except EgolocError as error:
        raise EgolocError(f"{source.where}: {error}") from None
    return RunNoise(folder, innovations, found, "")


class MissingLogError(EgolocError):
    """The log of a run is no longer where it was."""


def read_decisions(path: Path) -> Decisions:
    """The part of decisions.parquet that innovations are judged by; what is not read is zero."""
    table = read_table(path, COLUMNS)
    columns = {name: table[name] for name in COLUMNS}
    t_ns = columns["t_ns"].to_numpy()
    codes = {name: _codes(columns[name], kind) for name, kind in (("sensor", Sensor), ("reason", Reason))}
    value, sigma = (
        np.stack([columns[f"{name}_{i}"].to_numpy().astype(np.float64) for i in range(3)], axis=-1)
        for name in ("innovation", "innovation_sigma")
    )
    none, zero = np.zeros(len(t_ns), np.int64), np.zeros(len(t_ns))
    dof = none.astype(np.int8)
    return Decisions(
        t_ns, t_ns, codes["sensor"], none, codes["reason"], value, sigma, zero, zero, dof, zero, zero, zero
    )


def beginning(source: LogSource, config: RunConfig, duration_s: float) -> Log:
    """The first duration_s of a log as one record, in the vehicle and map frame of the run."""
    taken: list[Log] = []
    end_ns: int | None = None
    for piece in source.pieces(config):
        stamps = np.empty(0, np.int64) if piece.imu is None else piece.imu.t_ns
        if end_ns is None and len(stamps):
            end_ns = int(stamps[0]) + round(duration_s * NS_PER_S)
        if end_ns is not None and len(stamps) and stamps[0] >= end_ns:
            break
        taken.append(piece)
    whole = join(taken)
    if end_ns is not None:
        records = {name: getattr(whole, name) for name in SENSORS}
        cut = {name: r and r[: int(np.searchsorted(r.t_ns, end_ns))] for name, r in records.items()}
        held: dict[str, Any] = {name: record or None for name, record in cut.items()}
        whole = replace(whole, **held)
    return replace(whole, vehicle=config.vehicle or whole.vehicle, map_frame=config.map_frame or whole.map_frame)


def _source_of(folder: Path) -> LogSource:
    """The log that a run's manifest names, if it is still the same."""
    known = read_json(folder / "manifest.json").get("log", {})
    advice = "give it with --log"
    if "scenario" in known:
        where = f"scenario:{known['scenario']},seed={known['seed']}"
        source = parse(where if known.get("length_km") is None else f"{where},length_km={known['length_km']:g}")[0]
        if source.facts().get("sha256") != known.get("sha256"):
            raise MissingLogError(f"{where} is not the drive of this run: {advice}")
        return source
    path = Path(known.get("path", ""))
    if not path.is_file():
        raise MissingLogError(f"the log {path} is not there: {advice}")
    if file_hash(path) != known.get("sha256"):
        raise MissingLogError(f"the log {path} has changed since: {advice}")
    return McapSource(path)


def _codes(column: Any, kind: type[Sensor] | type[Reason]) -> Any:
    """(N,) int8 members of an enumeration by their lower-case names."""
    table = {member.name.lower(): int(member) for member in kind}
    encoded = column.combine_chunks().dictionary_encode() if not hasattr(column.type, "value_type") else None
    array = encoded if encoded is not None else column.unify_dictionaries().combine_chunks()
    known = np.array([table[name] for name in array.dictionary.to_pylist()] or [0], np.int8)
    return known[array.indices.to_numpy(zero_copy_only=False)]


def facts(noise: RunNoise) -> dict[str, Any]:
    """What `--json` prints."""
    found = noise.found
    return {
        "run": str(noise.run),
        "innovations": [_axis(axis) for axis in noise.innovations],
        "missing": noise.missing or None,
        "estimate": None if found is None else {name: asdict(each) for name, each in found.found.items()},
        "gain_log_likelihood": None if found is None else found.gain,
        "runs": None if found is None else found.runs,
        "innovations_then": None if found is None else [_axis(axis) for axis in found.after],
        "config_toml": None if found is None else config_lines(found),
    }


def config_lines(found: NoiseEstimate) -> str:
    """The lines to paste into a config: what the drive does not tell is left out.

    Share and time go with the inflation: they divide the same variance, and others would make another of it.
    """
    sections: dict[str, list[str]] = {}
    for name, each in found.found.items():
        section, field = name.split(".")
        telling = found.found[f"{section}.inflation"] if field.startswith("lasting") else each
        if telling.observed or telling.at_bound:
            lines = sections.setdefault(section, [])
            lines.append(f"{field} = {float(f'{each.value:.3g}')!r}")
            if field == "lasting_share":
                lines.append(f"white_share = {float(f'{1.0 - each.value:.3g}')!r}")
    return "\n\n".join("\n".join((f"[fusion.{section}]", *lines)) for section, lines in sections.items())


def _axis(axis: AxisInnovations) -> dict[str, Any]:
    return {**asdict(axis), "sensor": axis.sensor.name.lower()}
