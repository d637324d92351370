import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SO3
from scipy.spatial.transform import Rotation

from jaxtri.estimation import zoom
from jaxtri.estimation.two_view import refine
from jaxtri.geometry.epipolar import essential, sampson

FOCAL, N = 500.0, 300
SIGMA = jnp.asarray(0.4 / FOCAL)
TURN = [0.01, -0.02, 0.005]


def two_views(T, scale, *, flat=False, noise_px=0.3, seed=0):
    """Normalised points of a scene 2 to 5 units away, or of a wall at 3, whose camera moves by T, turns and zooms."""
    rng = np.random.default_rng(seed)
    X = np.column_stack([rng.uniform([-0.6, -0.45], [0.6, 0.45], (N, 2)), np.ones(N)])
    X *= np.full((N, 1), 3.0) if flat else rng.uniform(2, 5, (N, 1))
    Y = X @ Rotation.from_rotvec(TURN).as_matrix().T + T
    noise = rng.normal(0, noise_px / FOCAL, (2, N, 2))
    return X[:, :2] / X[:, 2:] + noise[0], scale * Y[:, :2] / Y[:, 2:] + noise[1]


def epipolar_cost(u1, u2, T):
    return float(_cost(jnp.asarray(T) / np.linalg.norm(T), u1, u2))


@jax.jit
def _cost(direction, u1, u2):
    found = refine(direction, SO3.exp(jnp.asarray(TURN)), u1, u2, jnp.ones(N, bool), SIGMA)
    E = essential(found.rotation.as_matrix(), found.translation)
    d = jax.vmap(lambda a, b: sampson(E, a, b))(u1, u2) / SIGMA
    return jnp.minimum(d**2, 16).sum()


def test_a_turn_and_a_zoom_are_found_whatever_stands_in_masked_slots():
    u1, u2 = two_views([0, 0, 0], 1.2, noise_px=0)
    mask = np.arange(N) < 200
    u2[200:], u2[:20] = np.nan, u2[:20] + 0.3  # a tenth are outliers
    found = zoom.fit(u1, u2, mask, float(SIGMA))
    np.testing.assert_allclose(found.turn, TURN, atol=2e-4)
    np.testing.assert_allclose(found.scale, 1.2, atol=2e-4)
    assert np.median(found.distance) < 0.1


@pytest.mark.parametrize("scale", [0.85, 1.0, 1.15])
def test_a_zoom_is_not_taken_for_a_motion(scale):
    u1, u2 = two_views([0, 0, 0], scale)
    found = zoom.fit(u1, u2, np.ones(N, bool), float(SIGMA))
    assert zoom.explains(found, epipolar_cost(u1, u2, [0.01, 0, -0.3]), 16.0)


@pytest.mark.parametrize(("T", "flat"), [([0.1, 0, 0], False), ([0.1, 0, 0], True), ([0.02, 0, -0.4], False)])
def test_a_motion_is_not_taken_for_a_zoom(T, flat):
    u1, u2 = two_views(T, 1.0, flat=flat)
    found = zoom.fit(u1, u2, np.ones(N, bool), float(SIGMA))
    assert not zoom.explains(found, epipolar_cost(u1, u2, T), 16.0)
