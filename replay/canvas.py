"""A rerun recording to draw columns on: lines, bands, marks, lanes and tracks over one drive's time."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike, NDArray

from replay.run_columns import Floats, Nanoseconds, gaps, spans

TIMELINE = "drive"
"""Time since the first stamp of all runs; the timeline "utc" has the stamps themselves."""
PAUSE = "-"
"""The state of a lane without data; not drawn."""
OTHER = 0x707070FF
Colour = tuple[int, int, int]


class Canvas:
    """Draws on one recording; entity paths are relative to `root`."""

    def __init__(self, recording: rr.RecordingStream, origin_ns: int, root: str) -> None:
        self.recording = recording
        self.origin_ns = origin_ns
        self.root = root

    def line(
        self,
        path: str,
        t_ns: Nanoseconds,
        values: ArrayLike,
        name: str,
        colour: Colour,
        width: float = 1.5,
        *,
        shown: bool = True,
    ) -> None:
        """A line through (N,) values, broken at pauses and at NaN; zoomed out, its extremes stay.

        A line that is not shown is switched on in the legend.
        """
        t, y = _broken(t_ns, np.asarray(values, np.float64))
        policy = rr.components.AggregationPolicy.MinMax
        look = {"colors": [colour], "names": [name], "widths": [width], "visible_series": [shown]}
        self.still(path, rr.SeriesLines(**look, aggregation_policy=policy))
        self._columns(path, t, rr.Scalars.columns(scalars=y))

    def steps(self, path: str, t_ns: Nanoseconds, values: ArrayLike, name: str, colour: Colour) -> None:
        """A line through (N,) values that seldom change, over pauses too: the ends of each run of equal values."""
        y = np.asarray(values, np.float64)
        finite = np.isfinite(y)
        t, y = t_ns[finite], y[finite]
        changes = y[1:] != y[:-1]
        ends = np.r_[True, changes] | np.r_[changes, True] if len(y) else changes
        policy = rr.components.AggregationPolicy.Off
        self.still(path, rr.SeriesLines(colors=[colour], names=[name], widths=[1.0], aggregation_policy=policy))
        self._columns(path, t[ends], rr.Scalars.columns(scalars=y[ends]))

    def band(self, path: str, t_ns: Nanoseconds, half_width: ArrayLike, name: str, colour: Colour) -> None:
        """A band of (N,) half widths to both sides of zero."""
        t, y = _broken(t_ns, np.asarray(half_width, np.float64))
        columns = rr.Measurements.columns(values=np.where(np.isfinite(y), 0.0, np.nan), variances=y**2)
        self.still(path, rr.Measurements.from_fields(colors=[(*colour, 90)], names=[name], widths=[0.5]))
        self._columns(path, t, columns)

    def marks(
        self, path: str, t_ns: Nanoseconds, values: ArrayLike, name: str, colour: Colour, size: float = 1.5
    ) -> None:
        """A mark at each of (N,) values that is finite."""
        y = np.asarray(values, np.float64)
        finite = np.isfinite(y)
        self.still(
            path, rr.SeriesPoints(colors=[(*colour, 150)], names=[name], markers=["circle"], marker_sizes=[size])
        )
        self._columns(path, t_ns[finite], rr.Scalars.columns(scalars=y[finite]))

    def lane(
        self, path: str, t_ns: Nanoseconds, codes: NDArray[Any], names: Sequence[str], colours: Mapping[str, int]
    ) -> None:
        """A lane of states: (N,) codes into names; empty over pauses."""
        t, changes = spans(t_ns, codes)
        shown = {name: colours.get(name, OTHER) for name in names}
        self.still(
            path,
            rr.StateConfiguration(
                values=[*shown, PAUSE],
                colors=np.array([*shown.values(), 0], np.uint32),
                visible=[True] * len(shown) + [False],
            ),
        )
        self._columns(path, t, rr.StateChange.columns(state=[names[code] if code >= 0 else PAUSE for code in changes]))

    def vehicle(self, path: str, t_ns: Nanoseconds, places: Floats, colour: Colour, name: str) -> None:
        """A dot that moves along (N, 3) places."""
        self.still(path, rr.Points3D.from_fields(colors=[colour], radii=rr.Radius.ui_points(6.0), labels=[name]))
        self._columns(path, t_ns, rr.Points3D.columns(positions=places))

    def still(self, path: str, what: rr.AsComponents) -> None:
        """Something that does not change with time."""
        self.recording.log(f"{self.root}/{path}", what, static=True)

    def _columns(self, path: str, t_ns: Nanoseconds, columns: Any) -> None:
        if not len(t_ns):  # the viewer panics over a chunk without rows
            return
        drive = rr.TimeColumn(TIMELINE, duration=(t_ns - self.origin_ns).astype("timedelta64[ns]"))
        utc = rr.TimeColumn("utc", timestamp=t_ns.astype("datetime64[ns]"))
        self.recording.send_columns(f"{self.root}/{path}", indexes=[drive, utc], columns=columns)


def _broken(t_ns: Nanoseconds, values: Floats) -> tuple[Nanoseconds, Floats]:
    """The finite rows, with one NaN after each pause's last row, so that no line crosses it."""
    finite = np.isfinite(values)
    t, y = t_ns[finite], values[finite]
    after = gaps(t)
    return np.insert(t, after, t[after - 1] + 1), np.insert(y, after, np.nan)
