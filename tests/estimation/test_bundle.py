import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from jaxtri.estimation.bundle import (
    PointPrior,
    Precision,
    Views,
    linearise,
    points_given,
    reduce,
    seen_from,
    solver,
)
from jaxtri.estimation.bundle import cost as robust_cost
from jaxtri.geometry.pose import matrix, retract

K, N, SIGMA, SCALE = 5, 12, 1e-3, 16.0


@pytest.fixture(scope="module", params=[None, 0.8], ids=["white", "correlated"])
def problem(request):
    """Points seen from a few poses, some of them not, some of them badly; noise drawn anew, or kept in part."""
    rng = np.random.default_rng(0)
    errors = np.concatenate([rng.normal(size=(K, 3)) * 0.3, rng.normal(size=(K, 3)) * 0.1], axis=1)
    poses = jax.vmap(lambda e: retract(SE3.identity(), e))(jnp.asarray(errors))
    R, T = jax.vmap(lambda p: matrix(p.rotation()))(poses), poses.translation()
    first = rng.integers(0, K, N)
    rho = jnp.asarray(rng.uniform(0.2, 0.5, N)).at[0].set(0.0)  # one is infinitely far
    points = seen_from(R[first], T[first], jnp.asarray(rng.uniform(-0.3, 0.3, (2, N))), rho)
    Z = jnp.einsum("kij,jn->kin", R, points.X[:3]) + T[:, :, None] * points.X[3]
    observed = jnp.moveaxis(Z[:, :2] / Z[:, 2:], 1, 0) + rng.normal(size=(2, K, N)) * SIGMA
    observed = observed.at[:, 2, 5].add(20 * SIGMA)
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

    def residuals(errors):
        moved, X = flat(poses, points, errors)
        M = jnp.concatenate([jax.vmap(lambda p: matrix(p.rotation()))(moved), moved.translation()[:, :, None]], axis=2)
        Z = jnp.einsum("kij,jn->kin", M, X.X)
        left = (jnp.moveaxis(views.observed, 0, 1) - Z[:, :2] / Z[:, 2:]) / SIGMA
        beforehand = (prior.mean - X.inverse_depth) / prior.sd
        return jnp.concatenate([innovations(views, left, weights).ravel(), beforehand])

    zero = jnp.zeros(6 * K + 3 * N)
    J, r = -jax.jacfwd(residuals)(zero), residuals(zero)
    A, b = J.T @ J + 1e3 * jnp.diag(jnp.arange(6 * K + 3 * N) < 6 * K), J.T @ r
    whole = jnp.linalg.solve(A, b)
    reduced = reduce(said, points, prior)
    information = reduced.information + 1e3 * jnp.eye(6 * K)
    x = solver(information)(reduced.pull)
    np.testing.assert_allclose(x, whole[: 6 * K], rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(reduced.points(x).ravel(), whole[6 * K :], rtol=1e-5, atol=1e-7)
    given = points_given(said, points, prior, x.reshape(K, 6))
    np.testing.assert_allclose(given, reduced.points(x), rtol=1e-6, atol=1e-9)
    # So is the covariance: of the poses, and of the points, their own and what they owe to the poses.
    covariance = np.linalg.inv(A)
    C = solver(information)(jnp.eye(6 * K))
    np.testing.assert_allclose(C, covariance[: 6 * K, : 6 * K], rtol=1e-5, atol=1e-9)
    i = 7
    own = reduced.root[:, :, i].T @ (jnp.eye(3) + reduced.cross[:, :, i].T @ C @ reduced.cross[:, :, i])
    rows = 6 * K + N * np.arange(3) + i
    np.testing.assert_allclose(own @ reduced.root[:, :, i], covariance[np.ix_(rows, rows)], rtol=1e-5, atol=1e-10)


def test_weights_are_those_of_geman_and_mcclure(problem):
    """The gradient of the cost is what the weighted equations say it is; the one far off counts next to nothing."""
    poses, points, views, prior = problem

    @jax.jit
    def cost(errors):
        return linearise(*flat(poses, points, errors), views, jnp.asarray(SIGMA), jnp.asarray(SCALE)).cost

    slope = jax.grad(cost)(jnp.zeros(6 * K + 3 * N))
    said = linearise(poses, points, views, jnp.asarray(SIGMA), jnp.asarray(SCALE))
    assert said.weights[2, 5] < 0.01 < 0.5 < np.median(said.weights[views.mask])
    np.testing.assert_allclose(said.cost, robust_cost(poses, points, views, jnp.asarray(SIGMA), jnp.asarray(SCALE)))
    left = Precision.of(said.weights, said.kept) @ said.residual
    np.testing.assert_allclose(
        slope[: 6 * K], -2 * jnp.einsum("kean,kan->ke", said.pose, left).ravel(), rtol=1e-6, atol=1e-6
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
