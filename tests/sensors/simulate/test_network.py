"""Road networks: size, connection, geometry, shares of environments, fields over the plane."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sensors.errors import EgolocError
from sensors.simulate.environment import Environment, Road
from sensors.simulate.fields import BIAS_SCALE_M, map_errors
from sensors.simulate.network import Network, NetworkPlan, build_network
from tests.sensors.simulate.roads import ENVIRONMENTS, PLAN

Floats = NDArray[np.float64]


@pytest.fixture(scope="module", params=[0, 1])
def network(request: pytest.FixtureRequest) -> Network:
    return build_network(PLAN, ENVIRONMENTS, request.param)


def test_a_network_has_its_length_and_is_in_one_piece(network: Network) -> None:
    assert network.length_m == pytest.approx(1_000_000.0, rel=0.01)
    ends, count = network.graph.ends, len(network.graph.nodes)
    pieces, _ = connected_components(coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count)))
    assert pieces == 1
    # no dead end: a drive never has to turn round
    assert np.bincount(ends.ravel(), minlength=count).min() >= 2


def test_streets_have_the_length_of_blocks_and_some_are_missing_or_bent(network: Network) -> None:
    graph = network.graph
    street = ~graph.highway
    chord = np.linalg.norm(graph.nodes[graph.ends[street, 1]] - graph.nodes[graph.ends[street, 0]], axis=1)
    assert chord.min() > 60.0
    assert chord.max() < 350.0
    bent = np.diff(graph.first)[street] == 3
    assert bent.mean() == pytest.approx(0.3, abs=0.05)
    degree = np.bincount(graph.ends.ravel())
    # a full lattice of 5 x 5 to 7 x 7 blocks has about 3.4 streets at a junction
    assert 2.8 < degree.mean() < 3.3


def test_edges_run_from_end_to_end_and_their_curves_fit(network: Network) -> None:
    graph = network.graph
    np.testing.assert_array_equal(graph.vertices[graph.first[:-1]], graph.nodes[graph.ends[:, 0]])
    np.testing.assert_array_equal(graph.vertices[graph.first[1:] - 1], graph.nodes[graph.ends[:, 1]])
    np.testing.assert_allclose(np.diff(network.line), graph.lengths(), atol=1e-6)
    for highway, tightest_m in ((False, 60.0), (True, 400.0)):
        for edge in np.flatnonzero(graph.highway == highway):
            rows = slice(graph.first[edge], graph.first[edge + 1])
            radius = graph.radius[rows][1:-1]
            assert (radius >= tightest_m).all()
            step = np.diff(graph.vertices[rows], axis=0)
            length, heading = np.hypot(*step.T), np.arctan2(step[:, 1], step[:, 0])
            tangent = radius * np.tan(np.abs(np.angle(np.exp(1j * np.diff(heading)))) / 2)
            assert (tangent <= 0.45 * np.minimum(length[1:], length[:-1])).all()


@pytest.mark.parametrize("seed", range(4))
def test_environments_have_their_shares_of_the_kilometres(seed: int) -> None:
    network = build_network(PLAN, ENVIRONMENTS, seed)
    km = np.bincount(network.stretches.kind, np.diff(network.stretches.at)) / network.length_m
    share = np.array([e.share for e in network.environments])
    np.testing.assert_allclose(km, share / share.sum(), rtol=0.06, atol=0.002)


def test_stretches_lie_where_they_belong_and_keep_their_range_of_lengths(network: Network) -> None:
    pieces, names = network.stretches, np.array(network.names)
    edge = np.searchsorted(network.line, pieces.at[:-1], side="right") - 1
    on_highway = network.graph.highway[edge]
    name = names[pieces.kind]
    assert not on_highway[np.isin(name, ["city", "canyon", "underpass"])].any()
    assert on_highway[name == "highway"].all()
    assert 0.0 < on_highway[name == "tunnel"].mean() < 1.0
    # pieces of one environment in a row; stretches at the ends of two roads may touch, a short road is one stretch
    change = np.flatnonzero(np.diff(pieces.kind, prepend=-1))
    length = np.diff(np.append(pieces.at[change], pieces.at[-1]))
    tunnels = length[names[pieces.kind[change]] == "tunnel"]
    assert tunnels.max() < 2 * 1560.0
    assert np.mean((tunnels >= 200.0) & (tunnels <= 1560.0)) > 0.95


def test_every_stretch_has_a_speed_limit_of_its_environment(network: Network) -> None:
    for kind, environment in enumerate(network.environments):
        limits = network.stretches.speed_limit[network.stretches.kind == kind]
        assert set(limits.tolist()) == set(environment.road.speed_limits)


def test_junctions_lie_on_the_ground_and_nothing_is_too_steep(network: Network) -> None:
    stretches = network.stretches
    assert np.abs(stretches.above_ground(network.line)).max() < 1e-9
    line = np.arange(0.0, network.length_m - 1.0, 1.0)
    rise, ahead = stretches.above_ground(line), stretches.above_ground(line + 0.1)
    assert rise.max() > 2.0
    assert rise.min() < -1.0
    piece = stretches.piece(line)
    steepest = np.array([e.road.grade_max for e in network.environments])[stretches.kind[piece]]
    inside = piece == stretches.piece(line + 0.1)
    assert (np.abs(ahead - rise)[inside] / 0.1 <= steepest[inside] - 0.7 * 0.04 + 1e-6).all()
    # ground: steepest slope of the sum of waves
    rng = np.random.default_rng(0)
    xy = rng.uniform(-20_000.0, 20_000.0, (20_000, 2))
    slope = np.hypot(*[(network.ground.at(xy + d) - network.ground.at(xy)) / 0.1 for d in np.eye(2) * 0.1])
    assert 0.015 < slope.max() <= 0.7 * 0.04 + 1e-6


def test_a_walk_is_on_every_road_equally_often(network: Network) -> None:
    turns = network.turns
    rows = np.arange(len(turns.onward))
    probability = np.diff(turns.until, axis=1, prepend=0.0)
    assert (probability >= 0.0).all()
    np.testing.assert_allclose(turns.until[:, -1], 1.0)
    # no U-turn, and what comes in at a road's end leaves by the roads that begin there
    assert (probability[turns.onward == (rows ^ 1)[:, None]] == 0.0).all()
    into = np.zeros(len(rows))
    np.add.at(into, turns.onward[probability > 0], probability[probability > 0])
    np.testing.assert_allclose(into, 1.0, atol=1e-6)
    head = network.graph.ends[rows // 2, 1 - rows % 2]
    tail = network.graph.ends[rows // 2, rows % 2]
    for slot in range(turns.onward.shape[1]):
        used = probability[:, slot] > 0
        np.testing.assert_array_equal(tail[turns.onward[used, slot]], head[used])


def test_straight_on_is_likelier_than_a_turn(network: Network) -> None:
    rng = np.random.default_rng(3)
    way = network.turns.walk(0, np.diff(network.line), 3e6, rng)
    graph = network.graph
    first, last = graph.first[:-1], graph.first[1:] - 1
    leaves = np.empty((2 * len(first), 2))
    leaves[0::2] = graph.vertices[first + 1] - graph.vertices[first]
    leaves[1::2] = graph.vertices[last - 1] - graph.vertices[last]
    leaves /= np.linalg.norm(leaves, axis=1, keepdims=True)
    cosine = -np.einsum("ni,ni->n", leaves[way[:-1] ^ 1], leaves[way[1:]])
    crossing = np.bincount(graph.ends.ravel())[graph.ends[way[:-1] // 2, 1 - way[:-1] % 2]] == 4
    assert 0.5 < np.mean(cosine[crossing] > 0.87) < 0.75


def test_the_same_seed_gives_the_same_network_and_processes_keep_it() -> None:
    a = build_network(PLAN, ENVIRONMENTS, 0)
    assert build_network(PLAN, dict(ENVIRONMENTS), 0) is a
    other = build_network(PLAN, ENVIRONMENTS, 1)
    assert len(other.graph.nodes) != len(a.graph.nodes) or not np.array_equal(other.graph.nodes, a.graph.nodes)
    from sensors.simulate.network import _built

    _built.cache_clear()
    again = build_network(PLAN, ENVIRONMENTS, 0)
    assert again is not a
    np.testing.assert_array_equal(again.graph.vertices, a.graph.vertices)
    np.testing.assert_array_equal(again.stretches.at, a.stretches.at)
    np.testing.assert_array_equal(again.turns.until, a.turns.until)


@pytest.mark.parametrize(
    ("plan", "environments"),
    [
        (NetworkPlan(length_km=20.0), ENVIRONMENTS),
        (NetworkPlan(length_km=60.0), {"city": Environment()}),
        (NetworkPlan(length_km=200.0), {"highway": Environment(road=Road(on="highways"))}),
        (NetworkPlan(length_km=100.0), {"anything": Environment(road=Road(on="any"))}),
        (NetworkPlan(length_km=100.0, block_min_m=150.0, block_max_m=150.0, missing=0.0, bent=0.0), ENVIRONMENTS),
    ],
)
def test_other_networks(plan: NetworkPlan, environments: dict[str, Environment]) -> None:
    network = build_network(plan, environments, 3)
    assert network.length_m == pytest.approx(plan.length_km * 1000, rel=0.2)
    degree = np.bincount(network.graph.ends.ravel(), minlength=len(network.graph.nodes))
    assert degree.min() >= 2
    way = network.turns.walk(0, np.diff(network.line), 50_000.0, np.random.default_rng(0))
    assert len(set((way // 2).tolist())) > 3


def test_environments_without_a_share_lie_nowhere() -> None:
    network = build_network(NetworkPlan(length_km=50.0), {"a": Environment(), "b": Environment(share=0.0)}, 0)
    assert network.names == ("a",)
    with pytest.raises(EgolocError, match="at least one with a share above 0"):
        build_network(NetworkPlan(), {"b": Environment(share=0.0)}, 0)


def test_errors_of_the_map_have_unit_variance_and_keep_their_distance() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(-15_000.0, 15_000.0, (40_000, 2))
    direction = rng.normal(size=(40_000, 2))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    for seed in range(3):
        fields = map_errors(np.random.default_rng([seed]))
        values = np.stack([field.at(xy) for field in fields])
        np.testing.assert_allclose(values.mean(axis=1), 0.0, atol=0.05)
        np.testing.assert_allclose(values.var(axis=1), 1.0, atol=0.05)
        assert np.abs(np.corrcoef(values) - np.eye(3)).max() < 0.05
        there = np.stack([field.at(xy + BIAS_SCALE_M * direction) for field in fields])
        np.testing.assert_allclose((values * there).mean(axis=1), np.exp(-1.0), atol=0.08)
        far = np.stack([field.at(xy + 3000.0 * direction) for field in fields])
        assert np.abs((values * far).mean(axis=1)).max() < 0.1
