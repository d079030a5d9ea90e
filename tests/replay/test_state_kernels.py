"""The loops behind the tables, against plain numpy."""

import numpy as np

from replay._kernels import attitude_between, axis_sigmas, turn_states
from sensors.geodesy import MapFrame, rotation_map_enu
from sensors.rotation import interpolate_q, matrix_from_q

N = 50


def rng_and_q() -> tuple[np.random.Generator, np.ndarray]:
    rng = np.random.default_rng(7)
    q = rng.normal(size=(N, 4))
    return rng, q / np.linalg.norm(q, axis=1, keepdims=True)


def covariances(rng: np.random.Generator) -> np.ndarray:
    half = rng.normal(size=(N, 6, 6))
    return half @ half.transpose(0, 2, 1)


def test_states_are_turned_into_map_axes() -> None:
    rng, q = rng_and_q()
    cov = covariances(rng)
    llh = np.column_stack(
        (np.radians(rng.uniform(40, 60, N)), np.radians(rng.uniform(8, 14, N)), rng.uniform(0, 500, N))
    )
    for frame in (MapFrame("utm", zone=32), MapFrame("enu", (49.0, 8.4, 110.0))):
        R_map_enu, scale = rotation_map_enu(frame, llh)
        R_map_body, turned = turn_states(R_map_enu, scale, q, cov)
        np.testing.assert_allclose(R_map_body, R_map_enu @ matrix_from_q(q), atol=1e-14)
        turn = np.zeros((N, 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = R_map_enu
        turn[:, :2, :3] *= scale[:, None, None]
        np.testing.assert_allclose(turned, turn @ cov @ turn.transpose(0, 2, 1), atol=1e-12)


def test_sigmas_along_and_left_of_a_point_of_the_body() -> None:
    rng, _ = rng_and_q()
    cov, arm, heading = covariances(rng), rng.normal(size=(N, 3)), rng.uniform(-np.pi, np.pi, N)
    arm[: N // 2] = 0.0
    found = axis_sigmas(cov, arm, heading)
    for i in range(N):
        x, y, z = arm[i]
        to_point = np.hstack((np.eye(3), -np.array(((0, -z, y), (z, 0, -x), (-y, x, 0)))))  # dp + dtheta x arm
        plane = (to_point @ cov[i] @ to_point.T)[:2, :2]
        c, s = np.cos(heading[i]), np.sin(heading[i])
        axes = np.array(((c, s), (-s, c)))
        np.testing.assert_allclose(found[:, i], np.sqrt(np.diag(axes @ plane @ axes.T)), rtol=1e-12)
    nothing = axis_sigmas(np.full((1, 6, 6), np.nan), arm[:1], heading[:1])
    assert np.isnan(nothing).all()


def test_attitude_between_rows() -> None:
    rng, q = rng_and_q()
    q[10] = np.nan
    known = np.cumsum(rng.integers(1, 100, N))
    t_ns = np.sort(rng.integers(known[0], known[-1] + 1, 400))
    left = np.searchsorted(known, t_ns, side="right") - 1
    np.testing.assert_allclose(attitude_between(known, q, t_ns, left), interpolate_q(t_ns, known, q), atol=1e-14)
    assert np.isnan(attitude_between(known, np.zeros((N, 4)), t_ns, left)).all()
