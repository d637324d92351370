from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from intervals import nees_interval
from jaxlie import SE3, SO3
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxtri.geometry.camera import Camera
from jaxtri.geometry.pose import compose, exp_pose, local, multiply, retract
from jaxtri.odometry import window as windows
from jaxtri.odometry.settings import Settings
from jaxtri.odometry.window import Window

N, FRAMES, NOISE = 40, 24, 0.4 / 500
SETTINGS = Settings.of(Camera.from_parameters(500, 500, 320, 240, width=640, height=480), noise_px=0.4)
# Without robust weights the optimum is that of plain least squares; enough steps reach it. The camera is exact.
PLAIN = eqx.tree_at(lambda s: (s.robust.scale, s.calibration), SETTINGS, tuple(jnp.asarray([1e9, 0.0])))
start = jax.jit(windows.start, static_argnames="k")
add = jax.jit(windows.add, static_argnames="steps")
off, matrices = jax.jit(local), jax.jit(SE3.as_matrix)


@cache
def path():
    """The true poses, as matrices and as poses, and others somewhat off."""
    t, rng = np.arange(FRAMES)[:, None], np.random.default_rng(2)
    R = Rotation.from_rotvec(-np.sin(t / 4) * [0.03, 0.08, 0.05]).as_matrix()
    T = -np.einsum("tij,tj->ti", R, t * [0.12, 0.01, 0.03])
    made = jax.jit(lambda R, T, e: (pose := compose(SO3.from_matrix(R), T), multiply(exp_pose(e), pose)))
    poses, guesses = zip(*(made(a, b, rng.normal(size=6) * 2e-3) for a, b in zip(R, T, strict=True)), strict=True)
    return R, T, poses, guesses


class Walk:
    """Keyframes along a wall of points; tracks end, and others begin in their slots."""

    def __init__(self, noise=NOISE, lives=FRAMES, seed=1):
        rng = np.random.default_rng(1)
        R, T, self.poses, self.guesses = path()
        age = rng.integers(0, lives, N) if lives < FRAMES else np.zeros(N, int)
        self.generation = (np.arange(FRAMES)[:, None] + age) // lives
        points = rng.uniform([-2, -1.5, 4], [4, 1.5, 7], (self.generation.max() + 1, N, 3))
        Y = np.einsum("tij,tnj->tni", R, points[self.generation, np.arange(N)]) + T[:, None]
        noises = np.random.default_rng(seed).normal(size=(FRAMES, N, 2)) * noise
        self.u = Y[..., :2] / Y[..., 2:] + noises

    def run(self, k, settings, refinements=1):
        """Windows and what they say after every keyframe from the second on, from poses somewhat off."""
        seen, depth = jnp.ones(N, bool), jnp.asarray(5.5)
        common = jnp.asarray(self.generation[0] == self.generation[1])
        window, refined = start(settings, self.u[0], self.u[1], common, self.poses[0], self.guesses[1], depth, k=k)
        found = [(window, refined)]
        for t in range(2, FRAMES):
            held = jnp.asarray(self.generation[t] == self.generation[t - 1])
            window, refined = add(
                settings, window, self.guesses[t], jnp.asarray(self.u[t]), seen, held, depth, steps=refinements
            )
            found.append((window, refined))
        return found


def newest(window):
    return jax.tree.map(lambda x: np.asarray(x)[-1], window.poses)


def test_all_keyframes_in_the_window_are_at_the_optimum_of_least_squares():
    walk = Walk()
    window, refined = walk.run(FRAMES, PLAIN, refinements=6)[-1]
    poses = jax.tree.map(lambda x: x[-FRAMES:], window.poses)
    first, second = np.asarray(matrices(poses))[:2]
    length = np.linalg.norm((second @ np.linalg.inv(first))[:3, 3])

    def residuals(x):
        moved = jax.vmap(retract)(poses, jnp.concatenate([jnp.zeros(6), x[: 6 * FRAMES - 6]]).reshape(FRAMES, 6))
        T = jax.vmap(SE3.as_matrix)(moved)
        Z = jnp.einsum("tij,nj->tni", T[:, :3, :3], x[6 * FRAMES - 6 :].reshape(N, 3)) + T[:, None, :3, 3]
        gauge = 1e6 * (jnp.linalg.norm(T[1, :3, 3] - T[0, :3, 3]) - length)
        return jnp.append(((Z[..., :2] / Z[..., 2:] - walk.u) / SETTINGS.sigma).ravel(), gauge)

    X = np.asarray(refined.X)
    x = np.concatenate([np.zeros(6 * FRAMES - 6), (X[:3] / X[3]).T.ravel()])
    f, J = jax.jit(residuals), jax.jit(jax.jacfwd(residuals))
    best = least_squares(lambda x: np.asarray(f(x)), x, lambda x: np.asarray(J(x)), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    stated = np.sqrt(np.diag(refined.covariance)[-6 * FRAMES :])[6:]
    assert (np.abs(best.x[: 6 * FRAMES - 6]) < 0.02 * stated + 1e-9).all()
    # Its covariance is that of all unknowns together.
    C = np.linalg.inv(best.jac.T @ best.jac)[: 6 * FRAMES - 6, : 6 * FRAMES - 6]
    # Taken two hundredths of it apart, where the scale is another.
    np.testing.assert_allclose(stated, np.sqrt(np.diag(C)), rtol=5e-3, atol=1e-6)


@pytest.mark.parametrize("lives", [6, FRAMES])
def test_what_leaves_the_window_is_not_forgotten_and_not_counted_twice(lives):
    """A small window gives the poses of one that holds all, and says no more of them: tracks end, or outlast it."""
    walk = Walk(lives=lives)
    (small, says), (whole, knows) = (walk.run(k, PLAIN, refinements=3)[-1] for k in (8, FRAMES + 1))
    C, C_small = np.asarray(knows.covariance[-6:, -6:]), np.asarray(says.covariance[-6:, -6:])
    apart = np.asarray(off(newest(whole), newest(small)))
    assert apart @ np.linalg.solve(C_small, apart) < nees_interval(6, 1)[1]
    # It knows no more than all observations together tell, but for what was linearised, and never loses the thread:
    # what a window of 8 forgets of tracks seen for 24 keyframes makes its orientation drift.
    ratios = np.sqrt(np.diag(C_small) / np.diag(C))
    assert ratios.min() > 0.8
    assert ratios.max() < 8


def test_a_similarity_of_the_world_changes_nothing_of_the_prior():
    """Poses improved, what was said before still says nothing of the world's place, orientation and scale."""
    window, _ = Walk(lives=6).run(8, PLAIN, refinements=3)[-1]
    # Without what the gauge, which says it on purpose, has left there.
    gauge = jax.jit(windows._gauge)
    N0 = np.asarray(gauge(window.poses))
    P = np.eye(len(N0)) - N0 @ np.linalg.pinv(N0)
    blind = window._replace(
        information=jnp.asarray(P @ np.asarray(window.information) @ P), pull=jnp.asarray(P @ np.asarray(window.pull))
    )
    rng = np.random.default_rng(0)
    moved = jax.jit(jax.vmap(retract))(window.poses, jnp.asarray(rng.normal(size=(8, 6)) * 0.01))
    information, pull = map(np.asarray, jax.jit(windows._carried)(blind, moved))
    now = np.asarray(gauge(moved))
    size = np.linalg.norm(information) * np.linalg.norm(now, axis=0)
    assert (np.linalg.norm(information @ now, axis=0) < 1e-9 * size).all()
    assert np.abs(pull[:, 0] @ now).max() < 1e-9 * np.linalg.norm(pull[:, 0]) * np.linalg.norm(now)
    # The plain derivative would: this is what made the scale drift.
    J = jax.vmap(lambda a, b: jax.jacfwd(lambda e: local(a, retract(b, e)))(jnp.zeros(6)))
    A = np.zeros_like(P)
    for i, block in enumerate(np.asarray(jax.jit(J)(window.poses, moved))):
        A[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = block
    assert (np.linalg.norm(A.T @ np.asarray(blind.information) @ A @ now, axis=0) > 1e-5 * size).any()


def test_errors_are_those_that_the_covariance_says():
    """Of the newest pose over many noises, with tracks that end and keyframes that leave."""
    trials, squares, truth = 30, [], Walk(noise=0.0, lives=6)
    length = np.linalg.norm(truth.poses[1].translation())
    last = truth.poses[-1]
    apart = jax.jit(lambda pose, unit: local(pose, compose(last.rotation(), last.translation() * unit)))
    for seed in range(trials):
        found = Walk(lives=6, seed=seed).run(8, PLAIN, refinements=3)
        # The gauge: the first pose, and the length of the first base line.
        unit = np.linalg.norm(newest(found[0][0]).translation()) / length
        error = np.asarray(apart(newest(found[-1][0]), unit))
        squares.append(error @ np.linalg.solve(found[-1][1].covariance[-6:, -6:], error))
    low, high = nees_interval(6, trials)
    assert low < np.mean(squares) < high


def test_what_the_calibration_may_be_off_by_is_in_the_covariance():
    """Against what it does to the newest pose: focal length and centre moved, tracks that end, keyframes that leave."""
    walk, sd = Walk(noise=0.0, lives=6), 1e-3
    guessed = eqx.tree_at(lambda s: s.calibration, PLAIN, jnp.asarray([sd])[0])
    exact, guess = (walk.run(8, settings, refinements=3)[-1][1].covariance[-6:, -6:] for settings in (PLAIN, guessed))

    def found(focal, *centre):
        moved = Walk(noise=0.0, lives=6)
        moved.u = (walk.u - np.array(centre)) / (1 + focal)
        return newest(moved.run(8, PLAIN, refinements=3)[-1][0])

    moved = [np.asarray(off(found(*-e), found(*e))) / 2 for e in sd * np.eye(3)]
    expected = sum(np.outer(x, x) for x in moved)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose((guess - exact) / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.05)


def test_shapes_and_dtypes_stay():
    walk = Walk()
    single = partial(jax.tree.map, lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x)
    window, _ = walk.run(8, SETTINGS, refinements=3)[0]
    arguments = single((SETTINGS, window, walk.poses[2], jnp.asarray(walk.u[2]))), jnp.ones(N, bool), jnp.ones(N, bool)
    new, refined = jax.eval_shape(windows.add, *arguments[0], *arguments[1:], jnp.asarray(4.5, jnp.float32))
    assert isinstance(new, Window)
    same = jax.tree.map(lambda a, b: a.shape == b.shape and a.dtype == b.dtype, new, single(window))
    assert all(jax.tree.leaves(same))
    assert {x.dtype for x in jax.tree.leaves(refined)} == {jnp.dtype("float32"), jnp.dtype(bool)}
