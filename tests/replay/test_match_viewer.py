"""Matches as a rerun recording: read back, its entities, and where the map lies in it."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr

from egovm.projection import plane_height
from replay.match_drawing import ends_at, error_of, estimated_offset
from replay.match_viewer import write_matches
from sensors.errors import EgolocError
from sensors.maps.vector_map import Kind
from tests.egovm.made_map import made
from tests.replay.matches import NO_WALL, POLE_M, Around, camera, frame, pictured
from tests.sensors.mcap.messages import START_NS

STEP_NS = 100_000_000


def column(path: Path, entity: str, name: str) -> list[Any]:
    """The values of a component in time order, a row for each time; static ones are left out."""
    rows = []
    for chunk in rr.chunk.RrdReader(str(path)).stream().to_chunks():
        batch = chunk.to_record_batch()
        names = [field for field in batch.schema.names if field.endswith(f":{name}")]
        if chunk.entity_path == entity and names and "frame_time" in batch.schema.names:
            times = batch.column("frame_time").cast("int64").to_pylist()
            rows += zip(times, batch.column(names[0]).to_pylist(), strict=True)
    return [value for _, value in sorted(rows, key=lambda row: row[0])]


def test_a_recording_holds_what_was_drawn(tmp_path: Path) -> None:
    seen = [
        pictured(seen=frame(START_NS, images=(camera(),))),
        pictured(seen=frame(START_NS + STEP_NS, points=0)),
        pictured(seen=frame(START_NS + 2 * STEP_NS, seed=2), around=Around(made(), NO_WALL)),
        pictured(seen=frame(START_NS + 3 * STEP_NS, seed=3)),
    ]
    path = tmp_path / "m.rrd"
    write_matches(seen, path)
    rows: Counter[str] = Counter()
    for chunk in rr.chunk.RrdReader(str(path)).stream().to_chunks():
        rows[chunk.entity_path] += chunk.num_rows if "frame_time" in chunk.to_record_batch().schema.names else 0
    expected = {"/body/points": 3, "/summary": 4, "/histogram/0/mass": 3, "/histogram/0/poses/truth": 3}
    expected |= {f"/bev/{sort}/{level}": 3 for sort in ("features", "semantics", "map") for level in range(3)}
    expected |= {f"/histogram/{level}/{sort}": 2 for level in range(3) for sort in ("ellipse", "poses/mean")}
    expected |= {f"/body/map/{moment}/lines": 4 for moment in ("before", "after")}
    expected |= {f"/cameras/ahead/{sort}": 1 for sort in ("image", "before", "after")}
    expected |= {f"/{series}/{axis}": 2 for series in ("offset", "sigma", "error") for axis in ("lon", "lat", "yaw")}
    assert {entity: rows[entity] for entity in expected} == expected
    for name, figures in (("offset", estimated_offset), ("error", lambda match: error_of(match, seen[0].truth))):
        assert np.ravel(column(path, f"/{name}/lon", "scalars")) == pytest.approx(
            [figures(each.match)[0] for each in (seen[0], seen[3])]
        )


def test_the_map_lies_in_it_before_and_after(tmp_path: Path) -> None:
    seen = pictured()
    path = tmp_path / "m.rrd"
    write_matches([seen], path)
    pieces = seen.match.pieces
    for moment, offset in (("before", np.zeros(3)), ("after", estimated_offset(seen.match))):
        ends = ends_at(pieces, offset)
        ends[..., 2] += plane_height(seen.bev, seen.bev.ground_m)
        pole = pieces.type == Kind.POLE
        ends[pole, 1, 2] += POLE_M
        (strips,) = column(path, f"/body/map/{moment}/lines", "strips")
        lines = np.isin(pieces.type, (Kind.LANE_LINE, Kind.STOP_LINE, Kind.POLE))
        np.testing.assert_allclose(np.array(strips), ends[lines], atol=1e-5)


def test_a_recording_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match=r"absent/m.rrd: cannot be written"):
        write_matches([pictured(seen=frame(points=0))], tmp_path / "absent/m.rrd")
    assert not list(tmp_path.iterdir())
