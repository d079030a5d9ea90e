"""Allan deviations of an IMU as a picture."""

from math import isinf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from replay.allan import AXES, UNITS, Analysis
from sensors.allan import SensorNoise, gauss_markov_variance

if TYPE_CHECKING:
    from numpy.typing import NDArray

COLOURS = {"x": "#c0392b", "y": "#27864b", "z": "#2a62b8", "all": "#222222"}
SENSORS = {"gyro": ("Gyro", "deg/h"), "accel": ("Accelerometer", "mg")}


def draw(analysis: Analysis, path: Path) -> None:
    """Write a PNG: of each axis the deviation with its error, and the noise that explains their mean."""
    figure = Figure(figsize=(12.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, sensor in zip(figure.subplots(1, 2), SENSORS, strict=True):
        _panel(axes, analysis, sensor)
    rest = analysis.facts["rest"]
    figure.suptitle(f"{analysis.facts['log']}: {rest['length_s']:.0f} s at rest, {analysis.facts['rate_hz']:g} Hz")
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _panel(axes: Any, analysis: Analysis, sensor: str) -> None:
    """One sensor."""
    curve, noise, scale = analysis.curves[sensor], analysis.noise[sensor], UNITS[sensor].drift_scale
    name, unit = SENSORS[sensor]
    for column, axis in enumerate(AXES[:3]):
        deviation = scale * np.sqrt(curve.variance[:, column])
        axes.errorbar(
            curve.tau,
            deviation,
            deviation * np.minimum(curve.error, 0.9),
            color=COLOURS[axis],
            lw=1,
            capsize=2,
            label=axis,
        )
    every, tau = noise["all"], np.geomspace(curve.tau[0], curve.tau[-1], 200)
    for label, variance, style in parts_of(every, tau):
        axes.plot(tau, scale * np.sqrt(variance), style, color=COLOURS["all"], lw=1, label=label)
    lowest = scale * every.instability * np.sqrt(2.0 * np.log(2.0) / np.pi)
    words = "least" if every.instability_reached else "least (still falling)"
    axes.plot([every.instability_tau_s], [lowest], "o", mfc="none", color=COLOURS["all"], label=words)
    axes.set(xscale="log", yscale="log", title=name, xlabel="averaging time s", ylabel=f"Allan deviation {unit}")
    low, high = np.sqrt([curve.variance.min(), curve.variance.max()]) * scale
    axes.set_ylim(low / 2.0, high * 2.0)
    axes.grid(visible=True, which="both", lw=0.3)
    axes.legend(fontsize=8)


def parts_of(noise: SensorNoise, tau: "NDArray[np.float64]") -> list[tuple[str, "NDArray[np.float64]", str]]:
    """Name, Allan variance and line of the whole model and of its parts that show."""
    walk = noise.random_walk**2 / tau
    parts = [("random walk", walk, ":")] if noise.random_walk else []
    drift = np.zeros_like(tau)
    if noise.drift_rate and isinf(noise.drift_time_s):
        drift = noise.drift_rate**2 * tau / 3.0
        parts.append(("rate random walk", drift, "-."))
    elif noise.drift_rate:
        drift = noise.drift_sigma**2 * gauss_markov_variance(tau, noise.drift_time_s)
        parts.append((f"drift, {noise.drift_time_s:.0f} s", drift, "-."))
    return [("model of all", walk + drift + 3.0 * noise.quantization**2 / tau**2, "--"), *parts]
