"""What `egoloc allan` prints for people."""

from pathlib import Path
from typing import Any

from rich.table import Table

from replay.allan import AXES, UNITS, Analysis, vehicle_toml
from replay.table import DASH, bare_table, output_console

NAMES = {"gyro": "gyro", "accel": "accelerometer"}
WORDS = {
    "deg_per_sqrt_h": "deg/sqrt(h)",
    "m_per_s_per_sqrt_h": "m/s/sqrt(h)",
    "deg_per_h": "deg/h",
    "mg": "mg",
}


def print_analysis(analysis: Analysis, out: Path) -> None:
    """Both sensors, what to know of the figures, and the lines to paste."""
    facts, console = analysis.facts, output_console()
    rest = facts["rest"]
    console.print(
        f"At rest from {rest['from_s']:.1f} to {rest['to_s']:.1f} s of {facts['duration_s']:.1f} s: "
        f"{rest['length_s']:.1f} s, {facts['rate_hz']:.2f} Hz"
    )
    for sensor in UNITS:
        console.print("", _sensor_table(sensor, facts[sensor]), sep="\n")
    for warning in facts["warnings"]:
        console.print(f"Note: {warning}.", soft_wrap=True)
    console.print("\nFor a config (the filter takes the white noise times fusion.imu.noise_scale):\n", soft_wrap=True)
    console.print(vehicle_toml(analysis), markup=False, soft_wrap=True)
    console.print(f"Picture: {out / 'allan.png'}", soft_wrap=True)


def _sensor_table(sensor: str, axes: dict[str, dict[str, Any]]) -> Table:
    """One row an axis; +- is one standard deviation."""
    units = UNITS[sensor]
    walk, drift = WORDS[units.walk], WORDS[units.drift]
    table = bare_table(2)
    headers = (
        f"random walk\n{walk}",
        f"bias instability\n{drift}",
        "at\ns",
        f"rate random walk\n{drift}/sqrt(h)",
        f"drift sigma\n{drift}",
        "time constant\ns",
    )
    table.add_column(f"{NAMES[sensor]}\naxis")
    for header in headers:
        table.add_column(header, justify="right", no_wrap=True)
    for axis in AXES:
        found = axes[axis]
        below = "" if found["bias_instability_reached"] else "< "
        table.add_row(
            axis,
            _with_error(found[f"random_walk_{units.walk}"], found["random_walk_error"]),
            below + _with_error(found[f"bias_instability_{units.drift}"], found["bias_instability_error"]),
            f"{found['bias_instability_at_s']:.3g}",
            _with_error(found[f"rate_random_walk_{units.drift}_per_sqrt_h"], found["rate_random_walk_error"]),
            _figure(found[f"drift_sigma_{units.drift}"]),
            _figure(found["drift_time_s"]),
        )
    return table


def _with_error(value: float | None, error: float | None) -> str:
    """Three digits of both."""
    return DASH if value is None or error is None else f"{value:.3g} +- {error:.1g}"


def _figure(value: float | None) -> str:
    return DASH if value is None else f"{value:.3g}"
