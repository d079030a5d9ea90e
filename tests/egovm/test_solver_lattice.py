"""The lattice: its numbers, the group of offsets, and mistakes in its config."""

import math

import msgspec
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from egovm.config import LatticeConfig, NetworkConfig, SolverConfig
from egovm.lattice import between, candidates, compose, rotated, seen_from
from sensors.errors import EgolocError
from tests.egovm.reference_solver import lattice_poses, matrix, vector

LATTICE = LatticeConfig()
OFFSET = st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(-3.0, 3.0)).map(
    lambda x: torch.tensor(x, dtype=torch.float64)
)


def test_steps_are_the_cells_of_the_levels() -> None:
    assert [LATTICE.step_m(level) for level in range(3)] == [0.5, 0.25, 0.125]
    assert [math.degrees(LATTICE.step_rad(level)) for level in range(3)] == pytest.approx([0.5, 0.25, 0.125])
    LATTICE.check_cells((0.5, 0.25, 0.125))
    for wrong in ((0.5, 0.25), (0.5, 0.25, 0.2)):
        with pytest.raises(EgolocError, match="expected BEV cells of"):
            LATTICE.check_cells(wrong)


@pytest.mark.parametrize("level", range(3))
def test_candidates_are_those_of_the_reference(level: int) -> None:
    ours = candidates(LATTICE, level, torch.zeros(1, dtype=torch.float64)).flatten(0, 2)
    theirs = torch.stack([vector(pose) for pose in lattice_poses(level)])
    assert torch.allclose(ours, theirs, atol=1e-13)


@settings(max_examples=50, deadline=None)
@given(OFFSET, OFFSET, OFFSET)
def test_offsets_are_a_group(a: torch.Tensor, b: torch.Tensor, c: torch.Tensor) -> None:
    assert torch.allclose(compose(compose(a, b), c), compose(a, compose(b, c)))
    assert torch.allclose(compose(a, between(a, b)), b)
    assert torch.allclose(between(a, a), torch.zeros(3, dtype=torch.float64))
    product = matrix(*a) @ matrix(*b)
    assert torch.allclose(matrix(*compose(a, b)), product)


@settings(max_examples=50, deadline=None)
@given(OFFSET, OFFSET)
def test_places_are_seen_as_the_matrices_say(a: torch.Tensor, b: torch.Tensor) -> None:
    place = torch.tensor([3.0, -7.0], dtype=torch.float64)
    homogeneous = torch.cat((place, torch.ones(1, dtype=torch.float64)))
    assert torch.allclose(seen_from(a, place), (torch.linalg.inv(matrix(*a)) @ homogeneous)[:2])
    assert torch.allclose(seen_from(compose(a, b), place), seen_from(b, seen_from(a, place)))
    assert torch.allclose(rotated(rotated(place, a[2]), -a[2]), place)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"half_m": 0.0}, "half_m"),
        ({"half_deg": 90.0}, "half_deg"),
        ({"steps": 12}, "odd number"),
        ({"levels": 0}, "levels"),
    ],
)
def test_a_config_that_makes_no_lattice_is_refused(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(EgolocError, match=message):
        LatticeConfig(**wrong)  # type: ignore[arg-type]
    with pytest.raises(msgspec.ValidationError, match=message):
        msgspec.convert(wrong, LatticeConfig)


def test_a_network_whose_cells_are_no_steps_is_told() -> None:
    with pytest.raises(EgolocError, match="lattice: expected BEV cells of"):
        NetworkConfig(solver=SolverConfig(LatticeConfig(half_m=4.0)))
