from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3, SO3

from jaxtri import ekf
from jaxtri.geometry.pose import euler_from_matrix, matrix_from_euler
from jaxtri.models.motion import Kinematics, Twist, acceleration_noise, twist_noise
from jaxtri.models.trifocal import Trifocal, TrifocalState, informative, start
from jaxtri.synthetic.experiment import paper_experiment
from jaxtri.two_view import refine

POSE = jnp.array([0, 1, 2, 6, 7, 8])  # rows of the current translation and rotation
SD = {"velocity_sd": 0.01, "angular_velocity_sd": 0.02}


def track(experiment, paper=False):
    """Both modes, started from the maximum-likelihood pose of the first two frames."""
    observed, sigma = experiment.observed, experiment.sigma
    everything = jnp.ones(observed.shape[1], bool)
    truth = SO3.from_matrix(experiment.rotations[1])
    two_view = refine(experiment.translations[1], truth, observed[0], observed[1], everything, sigma)
    belief = start(two_view, euler=paper, **SD)
    zero = jnp.zeros_like(sigma)
    model = Trifocal(sigma, zero + 0.01, zero + 0.02, zero, two_view.translation, base_noise=not paper)
    pairs = jnp.concatenate([observed[0], observed[1]], -1)
    mask = jnp.broadcast_to(informative(belief.mean, pairs, sigma, 10.0), observed[2:].shape[:2])
    passes = 1 if paper else 4
    return two_view, ekf.filter(model, belief, pairs, observed[2:], mask, passes=passes)


@partial(jax.jit, static_argnames="paper")
@partial(jax.vmap, in_axes=(0, None))
def trial(key, paper):
    """Rotation error (degrees), translation error (metres), NEES of the pose, and the base line's length."""
    experiment = paper_experiment(key)
    two_view, (beliefs, _) = track(experiment, paper)
    R = jax.vmap(lambda state: state.motion.R)(beliefs.mean)
    turn = jax.vmap(lambda a, b: SO3.from_matrix(a @ b.T).log())(experiment.rotations[2:], R)
    shift = experiment.translations[2:] - beliefs.mean.motion.translation
    P = beliefs.covariance[:, POSE[:, None], POSE]
    error = jnp.concatenate([shift, turn], -1)
    nees = jax.vmap(lambda e, P: e @ jnp.linalg.solve(P, e))(error, P)
    length = jnp.linalg.norm(beliefs.mean.base_translation, axis=-1) / jnp.linalg.norm(two_view.translation)
    return jnp.rad2deg(jnp.linalg.norm(turn, axis=-1)), jnp.linalg.norm(shift, axis=-1), nees, length


@pytest.fixture(scope="module")
def trials():
    keys = jax.random.split(jax.random.key(1), 10)
    return {"default": trial(keys, False), "paper": trial(keys, True)}


# Yu et al. 2006, table I: 0.2417 degrees in total and 30.6 mm.
def test_default_mode_on_the_experiment_of_the_paper(trials):
    rotation, translation, nees, _ = trials["default"]
    assert rotation.mean() <= 0.0060
    assert translation.mean() <= 0.25e-3
    assert 4 < jnp.median(nees) < 9


def test_default_mode_gains_much_over_the_mode_of_the_paper(trials):
    default, paper = trials["default"], trials["paper"]
    assert paper[0].mean() <= 0.3
    assert paper[0].mean() > 5 * default[0].mean()
    assert paper[1].mean() > 3 * default[1].mean()


def test_scale_stays_pinned(trials):
    for _, _, _, length in trials.values():
        np.testing.assert_allclose(length, 1, rtol=1e-9)


def test_float32_run_is_finite_and_close():
    experiment = jax.tree.map(lambda x: x.astype(jnp.float32), jax.jit(paper_experiment)(jax.random.key(2)))
    two_view, (beliefs, diagnostics) = jax.jit(track)(experiment)
    for leaf in jax.tree.leaves((two_view, beliefs, eqx.filter(diagnostics, eqx.is_inexact_array))):
        assert leaf.dtype in (jnp.float32, jnp.bool_)
        assert np.isfinite(leaf).all()
    shift = experiment.translations[2:] - beliefs.mean.motion.translation
    assert np.linalg.norm(shift, axis=-1).mean() < 0.5e-3
    lengths = np.linalg.norm(beliefs.mean.base_translation, axis=-1)
    np.testing.assert_allclose(lengths, lengths[0], rtol=1e-5)


def small(paper):
    """A model, a belief and a few frames of the experiment, for gradients."""
    e = paper_experiment(jax.random.key(3), n_points=20, n_frames=4)
    R, T = SO3.from_matrix(e.rotations[1]), e.translations[1]
    two_view = refine(T, R, e.observed[0], e.observed[1], jnp.ones(20, bool), e.sigma)
    return e, start(two_view, euler=paper, **SD)


@pytest.mark.parametrize("paper", [False, True])
def test_likelihood_gradient_equals_central_differences(paper):
    e, belief = small(paper)
    pairs = jnp.concatenate([e.observed[0], e.observed[1]], -1)
    mask = jnp.broadcast_to(informative(belief.mean, pairs, e.sigma, 10.0), (2, 20))
    zero, epipole = jnp.zeros(()), belief.mean.base_translation

    @jax.jit
    @jax.vmap
    @jax.value_and_grad
    def likelihood(theta):
        sigma, acceleration, turn = jnp.exp(theta)
        model = Trifocal(sigma, acceleration, turn, zero, epipole, base_noise=not paper)
        passes = 1 if paper else 3
        return jnp.sum(ekf.filter(model, belief, pairs, e.observed[2:], mask, passes=passes)[1].log_likelihood)

    theta, h = jnp.log(jnp.array([e.sigma, 0.01, 0.02])), 1e-4
    steps = jnp.concatenate([jnp.zeros((1, 3)), h * jnp.eye(3), -h * jnp.eye(3)])
    values, gradients = likelihood(theta + steps)
    assert np.isfinite(gradients).all()
    np.testing.assert_allclose(gradients[0], (values[1:4] - values[4:]) / (2 * h), rtol=1e-5, atol=1e-5)


def test_noise_is_that_of_the_new_point_and_of_the_transfer():
    e, belief = small(False)
    model = Trifocal(e.sigma, *jnp.array([0.01, 0.02, 0.0]), belief.mean.base_translation)
    moved = model.predict(belief.mean, jnp.asarray(3.0))
    measure = jax.jit(lambda pair: model.measure(moved, pair))
    noise = jax.jit(lambda pair: model.noise(moved, pair))
    for pair in jnp.concatenate([e.observed[0], e.observed[1]], -1)[:5]:
        J = np.stack([measure(pair + h) - measure(pair - h) for h in 1e-6 * np.eye(4)], -1) / 2e-6
        np.testing.assert_allclose(noise(pair), e.sigma**2 * (np.eye(2) + J @ J.T), rtol=1e-6)
    constant = eqx.tree_at(lambda m: m.sigma, Trifocal(*[e.sigma] * 4, model.epipole, base_noise=False), e.sigma)
    np.testing.assert_allclose(constant.noise(moved, pair), e.sigma**2 * np.eye(2), rtol=1e-12)


@pytest.mark.parametrize("euler", [False, True])
def test_start_holds_one_pose_in_two_places(euler):
    e, _ = small(False)
    R, T = SO3.from_matrix(e.rotations[1]), e.translations[1]
    two_view = refine(T, R, e.observed[0], e.observed[1], jnp.ones(20, bool), e.sigma)
    belief = start(two_view, frames=4.0, euler=euler, **SD)
    P, base = np.asarray(belief.covariance), np.arange(12, 18)
    for rows in (POSE, base):
        for columns in (POSE, base):
            np.testing.assert_allclose(P[np.ix_(rows, columns)], P[np.ix_(base, base)], rtol=1e-12)
    # In terms of the rotation, whichever way it is held, the covariance is the two-view one.
    J = np.eye(6)
    if euler:
        h = 1e-6
        angles = [euler_from_matrix((SO3.exp(jnp.asarray(d)) @ R).as_matrix()) for d in h * np.eye(3)]
        J[3:, 3:] = np.stack([(a - euler_from_matrix(R.as_matrix())) / h for a in angles], -1)
    np.testing.assert_allclose(P[np.ix_(base, base)], J @ two_view.covariance @ J.T, rtol=1e-4, atol=1e-12)
    motion = belief.mean.motion
    np.testing.assert_allclose(motion.R, two_view.rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(motion.translation, belief.mean.base_translation)
    np.testing.assert_allclose(motion.velocity, two_view.translation / 4)
    back = motion.advance(jnp.asarray(-4.0))
    np.testing.assert_allclose(back.R, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(back.translation, 0, atol=1e-12)
    # The velocity's own variance adds to what it has from the pose.
    expected = P[np.ix_(POSE, POSE)] / 16 + np.diag([1e-4] * 3 + [4e-4] * 3)
    rows = np.array([3, 4, 5, 9, 10, 11])
    np.testing.assert_allclose(P[np.ix_(rows, rows)], expected, rtol=1e-12)


def test_pairs_without_depth_are_not_informative():
    zero, forward = jnp.zeros(3), jnp.array([0.0, 0.0, -0.5])
    state = TrifocalState(Kinematics(forward, zero, SO3.identity(), zero), forward, SO3.identity())
    pairs = jnp.array([[0.2, 0.1, 0.25, 0.125], [0.2, 0.1, 0.15, 0.075], [0.0, 0.0, 0.0, 0.0]])
    # In front, behind, and at the epipole.
    np.testing.assert_array_equal(informative(state, pairs, jnp.asarray(1e-3)), [True, False, False])
    np.testing.assert_array_equal(informative(state, pairs, jnp.asarray(1e-3), 1e3), False)


@pytest.mark.parametrize("kind", ["kinematics", "twist"])
def test_500_steps_in_float32_keep_the_rotation_a_rotation(kind):
    rate = jnp.array([0.3, -0.2, 0.1], jnp.float32)
    if kind == "kinematics":
        state = Kinematics(rate, rate, SO3.exp(rate), rate)
    else:
        state = Twist(SE3.exp(jnp.zeros(6)), jnp.concatenate([rate, rate]))
        state = jax.tree.map(lambda x: x.astype(jnp.float32), state)
    advance = jax.jit(lambda s: jax.lax.scan(lambda s, _: (s.advance(jnp.float32(1.0)), None), s, length=500)[0])
    after = advance(state)
    wxyz = after.rotation.wxyz if kind == "kinematics" else after.pose.rotation().wxyz
    assert wxyz.dtype == jnp.float32
    w, v = np.float64(wxyz[0]), np.float64(wxyz[1:])
    # Unnormalised on purpose: `as_matrix` would hide the growth.
    R = (w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v)
    R += 2 * w * np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    assert np.abs(R @ R.T - np.eye(3)).max() < 1e-5
    # And it has turned as far as it should.
    exact = SO3.exp(jnp.asarray(rate, jnp.float64) * (501 if kind == "kinematics" else 500)).as_matrix()
    assert np.abs(R - exact).max() < 1e-3


def test_euler_angles_advance_at_their_rates():
    state = Kinematics(*jnp.array([[0.0, 0, 0], [1.0, 2, 3], [0.1, 0.2, 0.3], [0.01, 0.02, 0.03]]))
    after = state.advance(jnp.asarray(2.0))
    np.testing.assert_allclose(after.translation, [2.0, 4, 6])
    np.testing.assert_allclose(after.R, matrix_from_euler(jnp.array([0.12, 0.24, 0.36])), rtol=1e-12)


def test_acceleration_noise_is_the_covariance_of_a_constant_acceleration():
    linear, angular, dt = 0.3, 0.2, 0.7
    G = np.array([dt**2 / 2, dt])
    arguments = jnp.asarray(linear), jnp.asarray(angular), jnp.asarray(dt)
    kinematics, twist = np.zeros((12, 12)), np.zeros((12, 12))
    for sd, offset in ((linear, 0), (angular, 6)):
        for i in range(3):
            column = np.zeros(12)
            column[[offset + i, offset + 3 + i]] = sd * G
            kinematics += np.outer(column, column)
            column = np.zeros(12)
            column[[offset // 2 + i, 6 + offset // 2 + i]] = sd * G
            twist += np.outer(column, column)
    np.testing.assert_allclose(acceleration_noise(*arguments), kinematics, rtol=1e-12)
    np.testing.assert_allclose(twist_noise(*arguments), twist, rtol=1e-12)
