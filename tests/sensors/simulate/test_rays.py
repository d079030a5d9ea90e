"""Rays in a scene: closed forms, and a caster that asks everything of every ray."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sensors.simulate.lidar import ELEVATION_DEG, beams
from sensors.simulate.scene import CELL_M, FIRST, GROUND, NOTHING, Hits, Scene, Solids

Floats = NDArray[np.float64]
FAR = 80.0


def solids(plates: object = (), posts: object = (), balls: object = (), strips: object = ()) -> Solids:
    widths = zip((plates, posts, balls, strips), (10, 6, 5, 10), strict=True)
    return Solids(*(np.array(rows, np.float64).reshape(-1, width) for rows, width in widths))


def level(things: Solids, height: float = 0.0, half: int = 25) -> Scene:
    """Things on level ground, 100 m to every side of the origin."""
    corner = np.full(2, -half * CELL_M)
    return Scene.of(corner, np.full((2 * half + 1, 2 * half + 1), height), things)


def shot(scene: Scene, origin: object, directions: Floats, most: float = FAR) -> Hits:
    """Hits (N,) of rays from one place."""
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    found = scene.cast(np.array([origin], np.float64), np.eye(3)[None], np.ascontiguousarray(unit[None]), most)
    return Hits(*(column[0] for column in found))


def fan(count: int = 200, spread: float = 0.6) -> tuple[Floats, Floats]:
    """Level rays around x, and their angles."""
    angle = np.linspace(-spread, spread, count)
    return np.stack((np.cos(angle), np.sin(angle), 0.0 * angle), axis=-1), angle


def test_a_wall_is_as_far_as_its_distance_over_the_cosine() -> None:
    wall = [10.0, -20.0, -1.0, 0.0, 40.0, 0.0, 0.0, 0.0, 5.0, 0.4]
    rays, angle = fan()
    found = shot(level(solids([wall])), (0.0, 0.0, 1.5), rays)
    np.testing.assert_allclose(found.distance, 10.0 / np.cos(angle), rtol=1e-13)
    np.testing.assert_allclose(found.cosine, np.cos(angle), rtol=1e-13)
    assert (found.what == FIRST).all()
    assert (found.reflectivity == 0.4).all()


def test_a_post_is_round() -> None:
    radius, apart = 0.5, 8.0
    rays, angle = fan(401, 0.1)
    found = shot(level(solids(posts=[[apart, 0.0, 0.0, 3.0, radius, 0.5]])), (0.0, 0.0, 1.5), rays)
    meets = np.abs(np.sin(angle)) * apart < radius
    chord = np.sqrt(np.maximum(radius**2 - (apart * np.sin(angle)) ** 2, 0.0))
    np.testing.assert_array_equal(found.what == FIRST, meets)
    np.testing.assert_allclose(found.distance[meets], (apart * np.cos(angle) - chord)[meets], rtol=1e-12)
    above = shot(level(solids(posts=[[apart, 0.0, 0.0, 1.4, radius, 0.5]])), (0.0, 0.0, 1.5), rays)
    assert (above.what == NOTHING).all()
    assert np.isinf(above.distance).all()


def test_rings_on_level_ground_are_circles() -> None:
    height = 1.9
    found = level(solids()).cast(np.array([[0.0, 0.0, height]]), np.eye(3)[None], beams(1800)[:1], FAR)
    down = np.radians(-ELEVATION_DEG)
    reaches = (down > 0) & (height < FAR * np.sin(down))
    np.testing.assert_array_equal(found.what[0] == GROUND, reaches)
    radius = found.distance[0][reaches] * np.cos(down[reaches])
    np.testing.assert_allclose(radius, height / np.tan(down[reaches]), rtol=1e-12)


def test_a_box_hides_what_is_behind_it() -> None:
    face = [5.0, -1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 3.0, 0.2]
    wall = [10.0, -20.0, -1.0, 0.0, 40.0, 0.0, 0.0, 0.0, 5.0, 0.4]
    rays, angle = fan()
    found = shot(level(solids([wall, face])), (0.0, 0.0, 1.5), rays)
    hidden = np.abs(np.tan(angle)) * 5.0 < 1.0
    np.testing.assert_array_equal(found.what, np.where(hidden, FIRST + 1, FIRST))


def test_paint_is_where_it_is() -> None:
    """Dashes of 2 m every 6 m, 0.2 m wide, from x = 1 to x = 21."""
    strip = [1.0, 0.0, 1.0, 0.0, 20.0, 0.1, 0.0, 6.0, 2.0, 0.8]
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0.05, 24.0, 300), (-0.11, -0.05, 0.0, 0.09, 0.2)))
    found = shot(level(solids(strips=[strip])), (0.0, 0.0, 2.0), np.stack((x, y, 0.0 * x - 2.0), axis=-1))
    painted = (np.abs(y) <= 0.1) & (x >= 1.0) & (x <= 21.0) & ((x - 1.0) % 6.0 <= 2.0)
    assert 0.1 < painted.mean() < 0.3
    np.testing.assert_array_equal(found.reflectivity == 0.8, painted)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_it_agrees_with_asking_everything(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = made_up(rng)
    inside = np.array(scene.ground.shape) - 1
    origin = np.append(scene.corner + rng.uniform(0.1, 0.9, 2) * inside * CELL_M, rng.uniform(-1.0, 8.0))
    rays = rng.normal(size=(300, 3)) * (1.0, 1.0, 0.4)
    rays[:6] = np.concatenate((np.eye(3), -np.eye(3)))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    found = shot(scene, origin, rays)
    wanted, what = brute(scene, origin, rays)
    np.testing.assert_allclose(found.distance, wanted, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(found.what, what)


def made_up(rng: np.random.Generator) -> Scene:
    """Anything, anywhere, some of it beyond the grid."""
    shape = rng.integers(2, 12, 2)
    corner = CELL_M * rng.integers(-2000, 2000, 2).astype(np.float64)
    size = shape * CELL_M

    def places(count: int) -> Floats:
        return np.column_stack((corner + rng.uniform(-0.2, 1.2, (count, 2)) * size, rng.uniform(-2.0, 6.0, count)))

    count = rng.integers(0, 12, 3)
    plates = np.column_stack((places(count[0]), rng.normal(0.0, 4.0, (count[0], 6)), rng.random(count[0])))
    foot = places(count[1])
    posts = np.column_stack((foot, foot[:, 2] + rng.uniform(0.5, 5.0, count[1]), rng.uniform(0.05, 3.0, (count[1], 2))))
    balls = np.column_stack((places(count[2]), rng.uniform(0.1, 3.0, (count[2], 2))))
    return Scene.of(corner, rng.normal(0.0, 0.8, shape + 1), solids(plates, posts, balls))


def brute(scene: Scene, p: Floats, d: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Distances (N,) and numbers (N,) of the first hits within the grid, by trying everything."""
    plates, posts, balls, _ = scene.solids
    tried = [_patches(scene, p, d)]
    tried += [_plate(row, p, d) for row in plates] + [_post(row, p, d) for row in posts]
    tried += [_ball(row, p, d) for row in balls]
    t = np.array(tried)
    end = scene.corner + (np.array(scene.ground.shape) - 1) * CELL_M
    with np.errstate(invalid="ignore"):
        place = p[:2] + t[..., None] * d[:, :2]
        inside = ((place >= scene.corner) & (place <= end)).all(axis=-1)
    t = np.where((t > 0.0) & (t <= FAR) & inside, t, np.inf)
    first = np.argmin(t, axis=0)
    distance = t[first, np.arange(len(d))]
    return distance, np.where(np.isinf(distance), NOTHING, first)


def _patches(scene: Scene, p: Floats, d: Floats) -> Floats:
    """Every patch of ground: height = its bilinear form, solved along the ray."""
    best = np.full(len(d), np.inf)
    for i, j in np.ndindex(scene.ground.shape[0] - 1, scene.ground.shape[1] - 1):
        a, b, c, e = scene.ground[i : i + 2, j : j + 2].ravel()
        x, y = (p[:2] - scene.corner) / CELL_M - (i, j)
        dx, dy = d[:, 0] / CELL_M, d[:, 1] / CELL_M
        twist = a - b - c + e
        form = (
            -twist * dx * dy,
            d[:, 2] - (c - a) * dx - (b - a) * dy - twist * (x * dy + y * dx),
            p[2] - a - (c - a) * x - (b - a) * y - twist * x * y,
        )
        for t in _roots(*form):
            with np.errstate(invalid="ignore"):
                u, v = x + t * dx, y + t * dy
            least, most = np.fmin(u, v), np.fmax(u, v)
            best = np.where((t > 0.0) & (t < best) & (least >= -1e-9) & (most <= 1.0 + 1e-9), t, best)
    return best


def _roots(a: Floats, b: Floats, c: float) -> tuple[Floats, Floats]:
    """Roots of a t^2 + b t + c, NaN or inf where there are none: the large one, and the other by their product."""
    with np.errstate(invalid="ignore", divide="ignore"):
        q = -0.5 * (b + np.where(b < 0.0, -1.0, 1.0) * np.sqrt(b * b - 4.0 * a * c))
        return q / a, c / q


def _plate(row: Floats, p: Floats, d: Floats) -> Floats:
    """o + a u + b v = p + t d, solved as three equations."""
    matrix = np.stack([np.broadcast_to(row[3:6], d.shape), np.broadcast_to(row[6:9], d.shape), -d], axis=-1)
    a, b, t = np.linalg.solve(matrix, np.broadcast_to(p - row[:3], d.shape)[..., None])[..., 0].T
    return np.where((a >= 0.0) & (a <= 1.0) & (b >= 0.0) & (b <= 1.0), t, np.inf)


def _post(row: Floats, p: Floats, d: Floats) -> Floats:
    away, along = p[:2] - row[:2], d[:, :2]
    near = _nearer((along**2).sum(axis=1), 2.0 * along @ away, away @ away - row[4] ** 2)
    with np.errstate(invalid="ignore"):
        z = p[2] + near * d[:, 2]
    return np.where((z >= row[2]) & (z <= row[3]), near, np.inf)


def _ball(row: Floats, p: Floats, d: Floats) -> Floats:
    away = p - row[:3]
    return _nearer(np.ones(len(d)), 2.0 * d @ away, away @ away - row[3] ** 2)


def _nearer(a: Floats, b: Floats, c: float) -> Floats:
    """The smaller root of a t^2 + b t + c, inf where there is none."""
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (-b - np.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    return np.where(np.isfinite(t), t, np.inf)
