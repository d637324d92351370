from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from intervals import nees_interval
from jaxlie import SE3

from jaxtri.estimation import batch, calibration
from jaxtri.estimation.batch import Estimate
from jaxtri.estimation.bundle import PointPrior, Views, linearise, looks, reduce, seen_from
from jaxtri.estimation.layers import Batch, Layer, Noise
from jaxtri.estimation.precision import block_diagonal
from jaxtri.estimation.tridiagonal import Factors, Tridiagonal
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.lenses import BrownConrady
from jaxtri.geometry.pose import retract

K, SMALL, LARGE = 16, 2, 4  # places, of which the last two are empty; blocks of two layers
SEEN, FARTHEST, SIGMA = 14, 13, 1e-3
NOISE = Noise(jnp.asarray(SIGMA), jnp.asarray(16.0), jnp.asarray(0.8))
PLAIN = Noise(jnp.asarray(SIGMA), jnp.asarray(1e9), jnp.asarray(0.8))


# Compiled once for the file: every problem is of one size.
optimum = jax.jit(partial(batch.optimum, most=60))
known = jax.jit(batch.known)
matrices = jax.jit(SE3.as_matrix)


@jax.jit
def between(to, of):
    """Errors of poses."""
    return jax.vmap(lambda a, b: (a @ b.inverse()).log())(to, of)


@jax.jit
def moved_by(poses, errors):
    return jax.vmap(retract)(poses, errors)


def camera_path():
    t = np.arange(K)[:, None]
    errors = np.concatenate([-t * [0.15, 0.01, 0.02], 0.05 * np.sin(t / 3) * [0.3, 1.0, 0.5]], axis=1)
    return moved_by(SE3.identity((K,)), jnp.asarray(errors))


def made(noise=0.0, seed=0):
    """A path before points; short and long tracks, each in the layer that holds it. The truth beside it."""
    rng = np.random.default_rng(1)
    poses = camera_path()
    M = np.asarray(matrices(poses))
    R, T = M[:, :3, :3], M[:, :3, 3]
    layers, truth, draw = [], [], np.random.default_rng(seed)
    for size, n in ((SMALL, 10), (LARGE, 8)):
        # Two chunks begin with the last block but one, and behind them stands what is not counted.
        begin = size * np.minimum(np.arange(K // size + 1), K // size - 2)
        chunks = len(begin)
        X = rng.uniform([-1.5, -1, 3], [3.5, 1, 6], (chunks, n, 3))
        mask = np.zeros((chunks, 2 * size, n), bool)
        for c in range(chunks):
            for i in range(n):
                first = rng.integers(0, size)
                mask[c, first : first + rng.integers(2, 2 * size + 1), i] = True
        at = begin[:, None] + np.arange(2 * size)
        mask[at >= SEEN] = False
        Z = np.einsum("cvij,cnj->cvin", R[at], X) + T[at][..., None]
        white = draw.normal(size=Z[:, :, :2].shape) * SIGMA * noise
        for v in range(1, 2 * size):  # a part of each error is that of the view before
            again = (mask[:, v] & mask[:, v - 1])[:, None]
            white[:, v] = np.where(again, 0.8 * white[:, v - 1] + 0.6 * white[:, v], white[:, v])
        observed = np.moveaxis(Z[:, :, :2] / Z[:, :, 2:] + white, 2, 1)
        prior = PointPrior(jnp.full((chunks, n), 0.2), jnp.full((chunks, n), 200.0))
        layers.append(Layer(*map(jnp.asarray, (observed, mask, begin, chunks - 1)), prior))
        truth.append(X[:-1])
    return Batch(tuple(layers), jnp.arange(K) < SEEN, jnp.asarray(FARTHEST)), poses, truth


@jax.jit
def begun(problem, poses):
    """Points by their first and last look."""

    def one(layer):
        first = jax.vmap(lambda c: looks(layer.chunk(c).of(poses), Views(*layer.chunk(c)[:2])))(
            jnp.arange(len(layer.mask))
        )
        return jax.vmap(seen_from)(first.R, first.T, first.u, jnp.clip(first.inverse_depth, 0.05, 1.0))

    return tuple(map(one, problem.layers))


def off(poses, size, seed=3):
    errors = np.random.default_rng(seed).normal(size=(K, 6)) * size
    errors[0] = 0
    return moved_by(poses, jnp.asarray(errors))


def test_the_equations_are_those_of_all_tracks_in_one_piece():
    """Blocks, layers, gauge and covariances: against one dense matrix of every pose."""
    problem, poses, _ = made(noise=1.0)
    points = begun(problem, poses)

    @jax.jit
    def reduced(observed, mask, chunk, prior):
        said = linearise(poses, chunk, Views(observed, mask, NOISE.correlation), *NOISE[:2])
        return reduce(said, chunk, prior)

    dense, pull = np.zeros((6 * K, 6 * K)), np.zeros(6 * K)
    for layer, p in zip(problem.layers, points, strict=True):
        for c in range(int(layer.chunks)):
            observed, mask = np.zeros((2, K, layer.mask.shape[2])), np.zeros((K, layer.mask.shape[2]), bool)
            rows = slice(layer.begin[c], layer.begin[c] + 2 * layer.size)
            observed[:, rows], mask[rows] = layer.observed[c], layer.mask[c]
            said = reduced(observed, mask, *jax.tree.map(lambda x, c=c: np.asarray(x)[c], (p, layer.prior)))
            dense, pull = dense + said.information, pull + said.pull
    # The first pose is given, and the distance of the one that is farthest; empty places have no errors.
    free = np.ones((K, 6, 6)) * np.eye(6)
    free[0] = free[SEEN:] = 0
    along = np.asarray(poses.translation())[FARTHEST]  # of the first pose's origin, which is the world's
    free[FARTHEST, :3, :3] -= np.outer(along, along) / (along @ along)
    P = np.asarray(block_diagonal(jnp.asarray(free)))
    covariance = np.linalg.pinv(P @ dense @ P, rcond=1e-11, hermitian=True)
    said = known(problem, NOISE, poses, points)
    own = covariance.reshape(K, 6, K, 6)[np.arange(K), :, np.arange(K)]
    np.testing.assert_allclose(said.covariance, own, rtol=1e-5, atol=1e-7 * own.max())
    # One step, undamped, is that of the dense equations.
    now = Estimate.of(poses, points)._replace(damping=jnp.asarray(0.0))
    step = jax.jit(batch.step)
    after, moved = step(problem, PLAIN, now), step(problem, NOISE, now)
    assert after.cost < 1e6
    x = P @ np.linalg.pinv(P @ dense @ P, rcond=1e-11, hermitian=True) @ P @ pull
    expected = np.array(moved_by(poses, jnp.asarray(x.reshape(K, 6))).wxyz_xyz)
    expected[FARTHEST, 4:] *= np.linalg.norm(along) / np.linalg.norm(expected[FARTHEST, 4:])  # given, not only at first
    np.testing.assert_allclose(moved.poses.wxyz_xyz, expected, atol=1e-7)


def test_factors_solve_and_invert_a_block_tridiagonal_matrix():
    rng = np.random.default_rng(0)
    root = np.kron(np.eye(4) + np.eye(4, k=1), np.ones((3, 3))) * rng.normal(size=(12, 12))
    A = root @ root.T + 3 * np.eye(12)
    blocks = A.reshape(4, 3, 4, 3).swapaxes(1, 2)
    at = np.arange(4)
    b = rng.normal(size=(4, 3))
    equations = Tridiagonal(*map(jnp.asarray, (blocks[at, at], blocks[at[:-1], at[1:]], b)))
    factors = Factors.of(equations, jnp.asarray(0.0))
    np.testing.assert_allclose(factors.solve(equations.pull).ravel(), np.linalg.solve(A, b.ravel()), rtol=1e-9)
    own = np.linalg.inv(A).reshape(4, 3, 4, 3)[at, :, at]
    np.testing.assert_allclose(factors.covariances(), own, rtol=1e-9, atol=1e-12)


def test_exact_points_lead_back_to_the_path():
    problem, poses, truth = made()
    wrong = off(poses, 0.01)
    found = optimum(problem, PLAIN, wrong, begun(problem, wrong), tolerance=1e-9)
    assert found.converged
    assert found.cost < 1e-4  # the vague prior's
    # Up to the gauge: the scale is that of the pose that is farthest, as it was given.
    scale = np.linalg.norm(wrong.translation()[FARTHEST]) / np.linalg.norm(poses.translation()[FARTHEST])
    assert abs(scale - 1) > 1e-3
    np.testing.assert_allclose(found.poses.translation()[:SEEN], scale * poses.translation()[:SEEN], atol=2e-6)
    np.testing.assert_allclose(found.poses.rotation().wxyz[:SEEN], poses.rotation().wxyz[:SEEN], atol=1e-6)
    for p, X, layer in zip(found.points, truth, problem.layers, strict=True):
        seen = np.asarray(layer.mask.sum(axis=1))[:-1] > 2
        xyz = np.moveaxis(np.asarray(p.X[:-1, :3] / p.X[:-1, 3:]), 1, 2)
        np.testing.assert_allclose(xyz[seen], scale * X[seen], rtol=1e-3, atol=1e-3)


def test_what_an_error_of_the_calibration_does_to_the_poses():
    """Against what it does: the optimum where all image points are moved by it."""
    problem, poses, _ = made()
    start = begun(problem, poses)
    response = known(problem, PLAIN, poses, start).calibration
    error = np.array([1e-3, -2e-3, 1e-3])  # focal length, as a share; principal point, in focal lengths

    def moved(sign):
        focal, *centre = sign * error
        centre = np.array(centre)[:, None, None]
        layers = [x._replace(observed=(x.observed - centre) / (1 + focal)) for x in problem.layers]
        return optimum(problem._replace(layers=tuple(layers)), PLAIN, poses, start, tolerance=1e-9).poses

    found = between(moved(1.0), moved(-1.0)) / 2
    expected = jnp.einsum("kep,p->ke", response, error)
    assert abs(expected).max() > 1e-6
    np.testing.assert_allclose(found[:SEEN], expected[:SEEN], atol=1e-3 * abs(expected).max())


def test_what_is_told_of_the_intrinsics():
    """Against the optimum of other intrinsics: its cost is a parabola, whose slope and poses are known beforehand."""
    problem, poses, _ = made()
    camera = Camera.from_parameters(500.0, 500.0, 320.0, 240.0, distortion=BrownConrady.from_coefficients([-0.1]))
    start = begun(problem, poses)
    by = np.array([2e-3, -1e-3, 1e-3, -1e-3, 2e-3])  # log of the focal length, principal point over it, k1, k2

    @jax.jit
    def seen(by):
        other = calibration.changed(camera, by)

        def again(layer):
            pixels = camera.to_pixels(jnp.moveaxis(layer.observed, 1, -1))
            return layer._replace(observed=jnp.moveaxis(other.to_normalised(pixels), -1, 1))

        return problem._replace(layers=tuple(map(again, problem.layers))), other, calibration.difference(camera, other)

    # What was seen is exact: the least cost is that of the change, and the pull leads back.
    exact = calibration.told(problem, PLAIN, poses, start, camera)
    information = exact.information
    told, found = [], []
    for sign in (-1.0, 1.0):
        moved, other, difference = seen(jnp.asarray(sign * by))
        np.testing.assert_allclose(difference, sign * by, atol=1e-12)
        found.append(optimum(moved, PLAIN, poses, start, tolerance=1e-9))
        told.append(calibration.told(moved, PLAIN, found[-1].poses, found[-1].points, other))
    costs = np.array([float(f.cost) for f in found])
    np.testing.assert_allclose(costs.mean(), by @ information @ by, rtol=2e-2)
    pull = (told[0].pull - told[1].pull) / 2
    np.testing.assert_allclose(pull, information @ by, atol=2e-2 * abs(information @ by).max())
    np.testing.assert_allclose(sum(s.sum(axis=(0, 2)) for s in told[0].scores), told[0].pull)
    moved = between(found[1].poses, found[0].poses) / 2
    expected = jnp.einsum("kep,p->ke", exact.response, by)
    np.testing.assert_allclose(moved[:SEEN], expected[:SEEN], atol=2e-2 * abs(expected).max())


def test_what_is_told_of_a_zoom():
    """The same of a focal length that changes on the way; and knots that change together are a change of it."""
    problem, poses, _ = made()
    camera = Camera.from_parameters(500.0, 500.0, 320.0, 240.0)
    start, at = begun(problem, poses), np.linspace(0, SEEN - 1, 3)
    knots = np.stack([np.interp(np.arange(K), at, e) for e in np.eye(3)], axis=1)
    by = np.array([0, 0, 0, 1e-3, -2e-3, 1.5e-3])

    @jax.jit
    def seen(by):
        def again(layer):
            frames = layer.begin[:, None] + jnp.arange(2 * layer.size)
            return layer._replace(observed=layer.observed * jnp.exp(-(knots @ by[3:])[frames])[:, None, :, None])

        return problem._replace(layers=tuple(map(again, problem.layers)))

    information = np.asarray(calibration.told(problem, PLAIN, poses, start, camera, jnp.asarray(knots)).information)
    np.testing.assert_allclose(information[:, 3:].sum(axis=1), information[:, 0], rtol=1e-9)
    pulls, costs = [], []
    for sign in (-1.0, 1.0):
        moved = seen(jnp.asarray(sign * by))
        found = optimum(moved, PLAIN, poses, start, tolerance=1e-9)
        pulls.append(calibration.told(moved, PLAIN, found.poses, found.points, camera, jnp.asarray(knots)).pull)
        costs.append(float(found.cost))
    np.testing.assert_allclose(np.mean(costs), by @ information @ by, rtol=2e-2)
    expected = information @ by
    np.testing.assert_allclose((pulls[0] - pulls[1]) / 2, expected, atol=2e-2 * abs(expected).max())


@pytest.mark.parametrize("lens", [None, [-0.25, 0.05], [0.1, 0.02, 1e-3, -1e-3]])
def test_where_a_pixel_is_seen_by_other_intrinsics(lens):
    camera = Camera.from_parameters(500.0, 480.0, 320.0, 240.0)
    if lens is not None:
        camera = replace(camera, distortion=BrownConrady.from_coefficients(lens))
    u = jnp.asarray(np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2)))
    pixels, p = camera.to_pixels(u), calibration.unknown(camera)
    assert p == (3 if lens is None else 5)
    step = 1e-6
    again = jax.jit(lambda x: calibration.changed(camera, x).to_normalised(pixels))
    slope = jax.jit(calibration.slope)(camera, u)
    for i, by in enumerate(np.eye(p) * step):
        np.testing.assert_allclose(slope[..., i], (again(by) - again(-by)) / (2 * step), atol=1e-6)


def test_covariances_are_those_of_the_errors():
    """NEES of the newest pose and of one in the middle over many noises, as correlated as they are taken to be."""
    problem, poses, _ = made()
    draws = 60
    start = begun(problem, poses)

    def run(seed):
        problem, *_ = made(noise=1.0, seed=seed)
        found = optimum(problem, PLAIN, poses, start, tolerance=1e-3)
        return between(poses, found.poses), known(problem, PLAIN, found.poses, found.points).covariance

    errors, C = map(np.stack, zip(*map(run, range(draws)), strict=True))
    for pose, free in ((6, np.arange(6)), (FARTHEST, np.arange(6))):
        e, c = errors[:, pose], C[:, pose]
        # Of the farthest pose the part along the base line is given: five are free.
        nees = np.einsum("da,dab,db->d", e, np.linalg.pinv(c, rcond=1e-9, hermitian=True), e)
        low, high = nees_interval(len(free) - (pose == FARTHEST), draws)
        assert low < nees.mean() < high, (pose, nees.mean(), low, high)


@pytest.fixture(scope="module")
def implicit():
    """A number drawn from the optimum, as far as it follows image points and noise; where it was found; differences."""
    problem, poses, _ = made(noise=1.0)
    start = begun(problem, poses)
    rng = np.random.default_rng(5)
    direction = jnp.asarray(rng.normal(size=problem.layers[1].observed.shape)) * SIGMA
    weights = jnp.asarray(rng.normal(size=(K, 6)))

    def shifted(s):
        long = problem.layers[1]._replace(observed=problem.layers[1].observed + s[0] * direction)
        noise = Noise(NOISE.sigma * jnp.exp(s[1]), NOISE.scale, NOISE.correlation + s[2])
        return problem._replace(layers=(problem.layers[0], long)), noise

    def value(s, found):
        at, points = batch.implicit(*shifted(s), found)
        return jnp.sum(weights * between(poses, at)) + jnp.sum(points[0].X * 1e-3)

    move = jax.jit(shifted)
    reverse = jax.jit(jax.value_and_grad(value))

    def found(s):
        return optimum(*move(s), poses, start, tolerance=1e-9)

    def best(s):
        return reverse(s, found(s))[0]

    zero, h = jnp.zeros(3), 1e-3
    central = [(best(x) - best(-x)) / (2 * h) for x in h * jnp.eye(3)]
    return {"forward": jax.jit(jax.jacfwd(value)), "reverse": lambda *x: reverse(*x)[1]}, (zero, found(zero)), central


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_derivatives_of_the_optimum(implicit, mode):
    """By the implicit function theorem, against central differences of the optimum itself."""
    slopes, at, central = implicit
    np.testing.assert_allclose(slopes[mode](*at), central, rtol=2e-4, atol=1e-8)
