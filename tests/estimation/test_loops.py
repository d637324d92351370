import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtri.estimation.loops import Closed, Loops, with_own
from jaxtri.estimation.tridiagonal import Tridiagonal
from jaxtri.geometry.pose import exp_pose, local, relative, retract

BLOCKS, SIZE, LOOPS = 3, 4, 4
POSES = BLOCKS * SIZE


def some(seed):
    """Normal equations of poses, block tridiagonal, and places seen again: one within a block, one that counts none."""
    rng = np.random.default_rng(seed)
    s = 6 * SIZE
    dense = np.zeros((BLOCKS * s, BLOCKS * s))
    for k in range(BLOCKS - 1):
        A = rng.normal(size=(2 * s, 3 * s))
        dense[k * s : (k + 2) * s, k * s : (k + 2) * s] += A @ A.T
    blocks = dense.reshape(BLOCKS, s, BLOCKS, s)
    diagonal, above = (
        jnp.asarray(np.stack(x))
        for x in ([blocks[k, :, k] for k in range(BLOCKS)], [blocks[k, :, k + 1] for k in range(BLOCKS - 1)])
    )
    pull = rng.normal(size=(BLOCKS, s))
    poses = jax.vmap(exp_pose)(jnp.asarray(rng.normal(size=(POSES, 6))))
    seen = jax.vmap(exp_pose)(jnp.asarray(0.3 * rng.normal(size=(LOOPS, 6))))
    keys = jnp.array([[11, 0, 1], [7, 2, 9], [6, 5, 4], [0, 0, 0]])
    weights = jnp.array([1.0, 0.4, 2.0, 0.0])
    loops = Loops(keys, seen, jnp.asarray(rng.normal(size=(LOOPS, 6, 6))), weights)
    free = jnp.broadcast_to(jnp.eye(6), (POSES, 6, 6)).at[0].set(0.0)  # the first pose is given
    return dense, Tridiagonal(diagonal, above, jnp.asarray(pull)), loops, poses, free


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_loops_are_what_they_are_in_dense_normal_equations(damping):
    dense, equations, loops, poses, free = some(0)

    def errors(x):
        moved = jax.vmap(retract)(poses, jnp.einsum("kab,kb->ka", free, x.reshape(POSES, 6)))
        return (jnp.sqrt(loops.weights)[:, None] * loops.errors(moved)).ravel()

    none = jnp.zeros(6 * POSES)
    J, e = np.asarray(jax.jacfwd(errors)(none)), np.asarray(errors(none))
    pull = np.asarray(equations.pull).ravel() - J.T @ e
    own = with_own(loops, poses, free, equations)
    np.testing.assert_allclose(own.pull.ravel(), pull, rtol=1e-10)
    full = dense + J.T @ J
    full += damping * np.diag(np.diag(full))
    closed = Closed.of(loops, poses, free, own, jnp.asarray(damping))
    np.testing.assert_allclose(closed.solve(own.pull).ravel(), np.linalg.solve(full, pull), rtol=1e-7, atol=1e-9)
    expected = np.linalg.inv(full).reshape(POSES, 6, POSES, 6)
    for k, found in enumerate(closed.covariances()):
        np.testing.assert_allclose(found, expected[k, :, k], rtol=1e-7, atol=1e-9)


def test_a_place_says_nothing_of_the_scale_at_which_it_was_followed():
    *_, loops, poses, _ = some(1)
    grown = type(poses).from_rotation_and_translation(poses.rotation(), 3.0 * poses.translation())
    # The last is no loop: its three keyframes are one.
    np.testing.assert_allclose(loops.errors(grown)[:-1], loops.errors(poses)[:-1], atol=1e-12)
    one = jax.tree.map(lambda x: x[0], loops)
    now, first, second = (jax.tree.map(lambda x, k=k: x[k], poses) for k in one.keys)
    between, length = relative(first, now), jnp.linalg.norm(relative(first, second).translation())
    there = type(between).from_rotation_and_translation(between.rotation(), between.translation() / length)
    np.testing.assert_allclose(loops.errors(poses)[0], one.root @ local(one.seen, there), atol=1e-12)
