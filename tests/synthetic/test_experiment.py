from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SO3

from jaxtri.synthetic.experiment import paper_experiment, steady_experiment


def test_what_the_paper_states_holds(key):
    e = jax.jit(paper_experiment)(key)
    assert e.observed.shape == (99, 300, 2)
    side = 0.13 ** (1 / 3)
    assert np.abs(np.asarray(e.points) - [0, 0, 0.33]).max() <= side / 2
    assert np.ptp(e.points, axis=0).min() > 0.9 * side
    turns = np.rad2deg(jax.vmap(lambda a, b: SO3.from_matrix(b @ a.T).log())(e.rotations[:-1], e.rotations[1:]))
    moved = np.abs(turns) > 1e-9
    assert not moved[:32].any()
    assert moved[34:].all()
    assert 0.19 < np.abs(turns[34:]).min() < np.abs(turns[34:]).max() < 1.21
    centre = np.array([0, 0, 0.33])
    shifts = np.diff(e.rotations @ centre + e.translations, axis=0)
    assert np.abs(shifts[34:64]).max() < 1e-12
    assert 0.005 <= np.abs(shifts[:32]).min() <= np.abs(shifts[:32]).max() <= 0.015
    noise = (e.observed - e.clean) * 600
    assert 0.099 < noise.std() < 0.101


def test_pitch_signs_and_gauge_are_what_is_asked_for(key):
    plain = jax.jit(paper_experiment)(key)
    fine = jax.jit(partial(paper_experiment, pixel_mm=0.005))(key)
    np.testing.assert_allclose(fine.sigma, plain.sigma / 2)
    np.testing.assert_allclose(fine.observed - fine.clean, (plain.observed - plain.clean) / 2, atol=1e-12)
    signs = jnp.array([[1.0, -1, 1, 1, 1, 1], [1, 1, 1, -1, 1, -1], [-1, 1, 1, 1, -1, 1]])
    e = jax.jit(paper_experiment)(key, signs=signs)
    steps = np.diff(e.translations[:30], axis=0)
    assert np.array_equal(np.sign(steps), np.tile(signs[0, :3], (29, 1)))
    one = jax.jit(partial(paper_experiment, base_line=1.0))(key)
    np.testing.assert_allclose(np.linalg.norm(one.translations[1]), 1)
    # A gauge: the images do not change.
    np.testing.assert_allclose(one.observed, plain.observed)
    X = np.einsum("tij,nj->tni", one.rotations, one.points) + one.translations[:, None]
    np.testing.assert_allclose(X[..., :2] / X[..., 2:], one.clean, rtol=1e-9)


def test_trials_are_batched(key):
    keys = jax.random.split(key, 3)
    many = jax.jit(jax.vmap(partial(paper_experiment, n_points=5, n_frames=4)))(keys)
    alone = jax.jit(partial(paper_experiment, n_points=5, n_frames=4))(keys[1])
    np.testing.assert_allclose(many.observed[1], alone.observed, rtol=1e-12)


def test_a_steady_camera_moves_as_told(key):
    still = {"jitter_m": 0.0, "jitter_degrees": 0.0, "n_frames": 20, "n_points": 10}
    forward = steady_experiment(key, metres_per_frame=(0.0, 0.0, 0.01), **still)
    np.testing.assert_allclose(forward.translations[:, 2], 0.01 * np.arange(20), atol=1e-12)
    np.testing.assert_allclose(forward.rotations, np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-12)
    orbit = steady_experiment(key, degrees_per_frame=(0.0, 0.7, 0.0), orbit=True, distance_m=2.0, **still)
    centre = orbit.rotations @ np.array([0, 0, 2.0]) + orbit.translations
    np.testing.assert_allclose(centre, np.broadcast_to([0, 0, 2.0], (20, 3)), atol=1e-12)
    cosine = (np.trace(orbit.rotations, axis1=1, axis2=2) - 1) / 2
    np.testing.assert_allclose(np.rad2deg(np.arccos(cosine[1:])), 0.7 * np.arange(1, 20), rtol=1e-6)
    turn = steady_experiment(key, degrees_per_frame=(0.0, 0.3, 0.0), **still)
    np.testing.assert_allclose(turn.translations, 0, atol=1e-12)
    noisy = steady_experiment(key, n_points=400, noise_px=0.5)
    np.testing.assert_allclose(np.std(noisy.observed - noisy.clean), 0.5 / 600, rtol=0.02)
