"""egoloc bench solver: every row is there, the peer agrees, and its counts are by hand."""

import pytest

from replay.bench.solver import run
from replay.cli import main


@pytest.mark.slow
def test_its_json_has_every_row() -> None:
    result = run(repeats=1, elements=6, scaling=(3, 6), sizes=("small",))
    assert set(result) == {"bench", "rows", "ratios", "conditions"}
    median = {(row["name"], row["metric"]): row["median"] for row in result["rows"]}
    assert len(median) == len(result["rows"])
    for name in ("egoloc, small", "sampling, small"):
        assert median[name, "forward_backward_ms"] > median[name, "forward_ms"] > 0
    assert len(result["ratios"]) == 2
    ratio = median["sampling, small", "forward_ms"] / median["egoloc, small", "forward_ms"]
    assert result["ratios"]["sampling / egoloc, small, forward"] == pytest.approx(ratio)
    for what in ("mean", "covariance", "offset"):
        assert median["egoloc against sampling, float64", f"{what}_difference"] < 1e-12
    assert median["sampling, small", "million_multiply_adds"] == pytest.approx(5 * 13**3 * 112 * 6 / 1e6)
    assert median["egoloc, small", "million_multiply_adds"] == pytest.approx((22**2 * 64 + 23**2 * 48) * 6 / 1e6)
    assert 0 <= median["egoloc, small, channels first", "peak_mb_beyond_inputs"] < 150


def test_no_elements_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "solver", "--elements", "0"]) == 2
    assert "--elements: expected 1 or more, got 0" in capsys.readouterr().err
