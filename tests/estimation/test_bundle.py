import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from jaxtri.estimation import bundle
from jaxtri.estimation.bundle import PointPrior, Precision, Views, points_given, seen_from, solver
from jaxtri.estimation.bundle import cost as robust_cost
from jaxtri.geometry.pose import matrix, retract

K, N, SIGMA, SCALE = 5, 12, 1e-3, 16.0

linearise, reduce = jax.jit(bundle.linearise), jax.jit(bundle.reduce)


@jax.jit
def made(errors):
    poses = jax.vmap(lambda e: retract(SE3.identity(), e))(errors)
    return poses, poses.as_matrix()


@pytest.fixture(scope="module", params=[None, 0.8], ids=["white", "correlated"])
def problem(request):
    """Points seen from a few poses, some of them not, some of them badly; noise drawn anew, or kept in part."""
    rng = np.random.default_rng(0)
    errors = np.concatenate([rng.normal(size=(K, 3)) * 0.3, rng.normal(size=(K, 3)) * 0.1], axis=1)
    poses, M = made(jnp.asarray(errors))
    R, T = np.asarray(M)[:, :3, :3], np.asarray(M)[:, :3, 3]
    first = rng.integers(0, K, N)
    rho = rng.uniform(0.2, 0.5, N)
    rho[0] = 0.0  # one is infinitely far
    points = jax.jit(seen_from)(R[first], T[first], rng.uniform(-0.3, 0.3, (2, N)), rho)
    X = np.asarray(points.X)
    Z = np.einsum("kij,jn->kin", R, X[:3]) + T[:, :, None] * X[3]
    observed = np.moveaxis(Z[:, :2] / Z[:, 2:], 1, 0) + rng.normal(size=(2, K, N)) * SIGMA
    observed[:, 2, 5] += 20 * SIGMA
    observed = jnp.asarray(observed)
    mask = jnp.asarray(rng.uniform(size=(K, N)) > 0.2)
    prior = PointPrior(jnp.full(N, 0.3), jnp.full(N, 2.0))
    correlation = None if request.param is None else jnp.asarray(request.param)
    return poses, points, Views(observed, mask, correlation), prior


def innovations(views, residual, weights):
    """What is new in each residual, over its standard deviation and weighted, view by view."""
    seen, phi = np.asarray(views.mask), views.correlation
    rows = []
    for k in range(K):
        kept = np.where(seen[k] & seen[k - 1], 0.0 if phi is None or k == 0 else phi, 0.0)
        new = (residual[k] - kept * residual[k - 1]) / np.sqrt(1 - kept**2)
        rows.append(jnp.where(seen[k], new * np.sqrt(weights[k]), 0.0))
    return jnp.stack(rows)


def flat(poses, points, errors):
    """Poses and points moved by one vector of errors."""
    moved = jax.vmap(retract)(poses, errors[: 6 * K].reshape(K, 6))
    return moved, points.moved(errors[6 * K :].reshape(3, N))


def test_the_reduced_equations_are_those_of_all_unknowns_together(problem):
    poses, points, views, prior = problem
    said = linearise(poses, points, views, jnp.asarray(SIGMA), jnp.asarray(SCALE))
    weights = np.asarray(said.weights)

    @jax.jit
    def residuals(errors):
        moved, X = flat(poses, points, errors)
        M = jnp.concatenate([jax.vmap(lambda p: matrix(p.rotation()))(moved), moved.translation()[:, :, None]], axis=2)
        Z = jnp.einsum("kij,jn->kin", M, X.X)
        left = (jnp.moveaxis(views.observed, 0, 1) - Z[:, :2] / Z[:, 2:]) / SIGMA
        beforehand = (prior.mean - X.inverse_depth) / prior.sd
        return jnp.concatenate([innovations(views, left, weights).ravel(), beforehand])

    zero = jnp.zeros(6 * K + 3 * N)
    J, r = -np.asarray(jax.jit(jax.jacfwd(residuals))(zero)), np.asarray(residuals(zero))
    A, b = J.T @ J + 1e3 * np.diag(np.arange(6 * K + 3 * N) < 6 * K), J.T @ r
    whole = np.linalg.solve(A, b)
    reduced = reduce(said, points, prior)
    information = reduced.information + 1e3 * np.eye(6 * K)
    solve = jax.jit(lambda A, b: solver(A)(b))
    x = solve(information, reduced.pull)
    np.testing.assert_allclose(x, whole[: 6 * K], rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(reduced.points(x).ravel(), whole[6 * K :], rtol=1e-5, atol=1e-7)
    given = jax.jit(points_given)(said, points, prior, x.reshape(K, 6))
    np.testing.assert_allclose(given, reduced.points(x), rtol=1e-6, atol=1e-9)
    # So is the covariance: of the poses, and of the points, their own and what they owe to the poses.
    covariance = np.linalg.inv(A)
    C = np.asarray(solve(information, jnp.eye(6 * K)))
    np.testing.assert_allclose(C, covariance[: 6 * K, : 6 * K], rtol=1e-5, atol=1e-9)
    i = 7
    root, cross = np.asarray(reduced.root)[:, :, i], np.asarray(reduced.cross)[:, :, i]
    own = root.T @ (np.eye(3) + cross.T @ C @ cross)
    rows = 6 * K + N * np.arange(3) + i
    np.testing.assert_allclose(own @ root, covariance[np.ix_(rows, rows)], rtol=1e-5, atol=1e-10)


def test_weights_are_those_of_geman_and_mcclure(problem):
    """The gradient of the cost is what the weighted equations say it is; the one far off counts next to nothing."""
    poses, points, views, prior = problem

    @jax.jit
    @jax.grad
    def slope(errors):
        return linearise(*flat(poses, points, errors), views, jnp.asarray(SIGMA), jnp.asarray(SCALE)).cost

    slope = slope(jnp.zeros(6 * K + 3 * N))
    said = linearise(poses, points, views, jnp.asarray(SIGMA), jnp.asarray(SCALE))
    assert said.weights[2, 5] < 0.01 < 0.5 < np.median(said.weights[views.mask])
    costs = jax.jit(robust_cost)(poses, points, views, jnp.asarray(SIGMA), jnp.asarray(SCALE))
    np.testing.assert_allclose(said.cost, costs)
    left = jax.jit(lambda said: Precision.of(said.weights, said.kept) @ said.residual)(said)
    np.testing.assert_allclose(
        slope[: 6 * K], -2 * np.einsum("kean,kan->ke", said.pose, left).ravel(), rtol=1e-6, atol=1e-6
    )
    # A pose nobody sees anything from, a point nobody sees and one behind every camera: no NaN, no say.
    unseen = views.mask.at[0].set(False).at[:, 3].set(False)
    blind = views._replace(observed=views.observed.at[:, 0].set(jnp.nan), mask=unseen)
    behind = points._replace(X=points.X.at[:3, 8].multiply(-1.0))
    reduced = reduce(linearise(poses, behind, blind, jnp.asarray(SIGMA), jnp.asarray(SCALE)), behind, prior)
    for leaf in jax.tree.leaves(reduced):
        assert np.isfinite(leaf).all()
    assert not reduced.information[:6].any()
    assert not reduced.cross[:, :, [3, 8]].any()


def test_what_is_said_in_parts_adds_up(problem):
    """A point's looks, divided between two points, say less than together; whole points apart say the same."""
    poses, points, views, prior = problem
    said = linearise(poses, points, views, jnp.asarray(SIGMA), jnp.asarray(SCALE))
    some = jnp.asarray(np.arange(N) < 5)[None] & jnp.ones((K, 1), bool)
    whole = reduce(said, points, prior)
    parts = [reduce(said, points, prior, mask) for mask in (some, ~some)]
    np.testing.assert_allclose(parts[0].information + parts[1].information, whole.information, rtol=1e-9, atol=1e-3)
    if views.correlation is not None:
        return  # halves of a track would have to agree on where their noise begins
    half = jnp.asarray(np.arange(K) < 3)[:, None] & jnp.ones((1, N), bool)
    parts = [reduce(said, points, prior, mask) for mask in (half, ~half)]
    less = whole.information - parts[0].information - parts[1].information
    assert np.linalg.eigvalsh(np.asarray(less)).min() > -1e-6 * np.linalg.norm(whole.information)
