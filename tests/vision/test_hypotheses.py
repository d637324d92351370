import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SO3
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jaxtri.errors import JaxtriError
from jaxtri.estimation.two_view import refine
from jaxtri.vision import hypotheses as module
from jaxtri.vision.hypotheses import hypotheses, poselib_poses

N, SIGMA = 64, 4e-4
R = Rotation.from_rotvec([0.02, -0.05, 0.03]).as_matrix()
T = np.array([0.9, 0.1, -np.sqrt(0.18)])


@pytest.fixture(scope="module")
def pair():
    """Two views of points about 4 base lines away, with noise in both."""
    rng = np.random.default_rng(0)
    X = rng.uniform([-2, -1.5, 3], [2, 1.5, 6], (N, 3))
    Y = X @ R.T + T
    return tuple(P[:, :2] / P[:, 2:] + SIGMA * rng.normal(size=(N, 2)) for P in (X, Y))


def find(pair, **more):
    return hypotheses(*pair, np.ones(N, bool), jnp.asarray(SIGMA), 4 * SIGMA, **more)


def squared_distance(translation, rotation, covariance):
    """Of a pose from the truth, squared and by a covariance that has nothing along T, the gauge."""
    error = np.r_[T - translation, Rotation.from_matrix(R @ rotation.T).as_rotvec()]
    return error @ np.linalg.pinv(covariance, rcond=1e-9, hermitian=True) @ error


def test_the_best_hypothesis_is_the_motion(pair):
    best = find(pair)[0]
    covariance = np.asarray(best.pose.covariance)
    distance = squared_distance(best.pose.translation, np.asarray(best.pose.rotation.as_matrix()), covariance)
    assert distance < chi2.ppf(0.999, 5)
    assert best.inside.mean() > 0.95
    assert best.parallax_deg > 5


def test_the_pose_by_poselib_is_within_the_covariance_of_the_truth(pair):
    pytest.importorskip("poselib", reason="starts by PoseLib need it: the extra `init`")
    ((rotation, translation),) = poselib_poses(*pair, 4 * SIGMA)
    mask = jnp.ones(N, bool)
    best = jax.jit(refine)(jnp.asarray(T), SO3.from_matrix(jnp.asarray(R)), *map(jnp.asarray, pair), mask, SIGMA)
    np.testing.assert_allclose(np.linalg.norm(translation), 1, rtol=1e-12)
    # Its last step is a least-squares one over the inliers: with this noise that of maximum likelihood.
    assert squared_distance(translation, rotation, np.asarray(best.covariance)) < chi2.ppf(0.999, 5)


def test_poselib_takes_part_where_it_is_asked_for_and_nowhere_else(pair, monkeypatch):
    asked = []

    def poses(*arguments):
        asked.append(arguments)
        return []

    monkeypatch.setattr(module, "poselib_poses", poses)
    find(pair)
    find(pair, eight_point=True, poselib=True)
    assert not asked
    find(pair, poselib=True)
    assert len(asked) == 1


def test_without_poselib_the_extra_is_named(pair, monkeypatch):
    monkeypatch.setitem(sys.modules, "poselib", None)
    find(pair)
    with pytest.raises(JaxtriError, match=r"jaxtri\[init\]"):
        find(pair, poselib=True)
