"""egoloc bench lidar: every row is there, and shares are shares."""

import pytest

from replay.bench.lidar import run


def test_its_rows() -> None:
    result = run(repeats=1, sweeps=2)
    median = {(row["name"], row["metric"]): row["median"] for row in result["rows"]}
    assert len(median) == len(result["rows"])
    assert {name for name, metric in median if metric == "ms"} == {"scene", "poses", "cast", "sweep"}
    assert 0.0 < median["cast", "ms"] < median["sweep", "ms"]
    for column in ("min", "median", "max"):
        assert all(0.0 <= row[column] <= 1.0 for row in result["rows"] if row["metric"] == "share")
    # two sweeps: the median of shares is their mean, and so they sum up to one
    assert sum(value for (_, metric), value in median.items() if metric == "share") == pytest.approx(1.0)
    assert 30_000 < median["points", "count"] < result["conditions"]["rays"] == 72_000
