"""Every wrong input at a public door ends with a message that names it, and what can be used is used."""

import dataclasses
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SO3
from jaxtyping import Array, Float

from jaxtri import (
    Belief,
    Camera,
    Odometry,
    Robust,
    Settings,
    StartSettings,
    Trifocal,
    ekf,
    follow_tracks,
    schmidt,
    tuning,
    two_view,
)
from jaxtri.errors import CameraError, InputError, UnitsWarning
from jaxtri.odometry.settings import Base

CAMERA = Camera.from_parameters(500, 500, 320, 240, width=640, height=480)


class Ramp(eqx.Module):
    """Position and velocity on a line, seen from items at a distance."""

    sigma: Float[Array, ""]

    def retract(self, mean, delta):
        return mean + delta

    def local(self, mean, other):
        return other - mean

    def predict(self, mean, dt):
        return mean.at[0].add(dt * mean[1])

    def process_noise(self, mean, dt):
        return 1e-3 * dt * jnp.eye(2, dtype=mean.dtype)

    def measure(self, mean, item):
        return mean[:1] - (0 if item is None else item)

    def noise(self, mean, item):
        return jnp.square(self.sigma) * jnp.eye(1, dtype=mean.dtype)


class Images(Ramp):
    normalised = True


MODEL, PRIOR = Ramp(jnp.asarray(0.1)), Belief(jnp.zeros(2), jnp.eye(2))
ITEMS = jnp.array([0.0, 1.0, 2.0])
OBSERVED = jnp.arange(12.0).reshape(4, 3, 1) / 10
MASK = jnp.ones((4, 3), bool).at[2, 1].set(False)


def run(model=MODEL, belief=PRIOR, items=ITEMS, observed=OBSERVED, mask=MASK, dt=None, **more):
    return ekf.filter(model, belief, items, observed, mask, dt, **more)[0]


def with_covariance(C):
    return Belief(jnp.zeros(2), jnp.asarray(C))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"passes": 0}, "passes is 0; give at least 1"),
        ({"block": 0}, "block is 0"),
        ({"belief": with_covariance([[1.0, 2.0], [2.0, 1.0]])}, "belief.covariance has a negative eigenvalue"),
        ({"belief": with_covariance([[-1.0, 0.0], [0.0, 1.0]])}, "belief.covariance has a negative"),
        ({"belief": with_covariance([[1.0, 0.5], [0.0, 1.0]])}, "belief.covariance is not symmetric"),
        ({"belief": with_covariance([[np.nan, 0.0], [0.0, 1.0]])}, "belief.covariance is not finite"),
        ({"model": Ramp(jnp.asarray(0.0))}, r"model.sigma is 0.0; it must be a positive"),
        ({"model": Ramp(jnp.asarray(-1.0))}, "model.sigma is -1.0"),
        ({"model": Ramp(jnp.asarray(jnp.nan))}, "model.sigma is nan"),
        ({"mask": np.ones((4, 3))}, "mask holds float64 numbers; give booleans"),
        ({"mask": jnp.ones((4, 3), jnp.int32)}, "mask holds int32 numbers"),
        ({"mask": MASK[:, :2]}, r"mask has shape \(4, 2\).* with n = 3 as in observed"),
        ({"observed": OBSERVED[..., 0]}, r"observed has shape \(4, 3\); it must be \(t, n, m\)"),
        ({"observed": OBSERVED[:0], "mask": MASK[:0]}, "holds nothing"),
        ({"observed": OBSERVED[:, :0], "mask": MASK[:, :0], "items": ITEMS[:0]}, "holds nothing"),
        ({"observed": [["a"]]}, "observed is no array of numbers"),
        ({"dt": jnp.ones(3)}, r"dt has shape \(3,\).* with t = 4"),
        ({"dt": jnp.array([1.0, jnp.inf, 1.0, 1.0])}, "dt is not finite"),
    ],
)
def test_what_a_filter_cannot_use_is_named(arguments, message):
    with pytest.raises(InputError, match=message):
        run(**arguments)


def test_an_error_says_whose_it_is():
    with pytest.raises(InputError, match="filter: passes"):
        run(passes=0)
    with pytest.raises(InputError, match="update: observed"):
        ekf.update(MODEL, PRIOR, ITEMS, OBSERVED)


def test_lists_and_numpy_arrays_are_as_good_as_jax_arrays():
    expected = run()
    plain = run(
        belief=jax.tree.map(np.asarray, PRIOR),
        items=np.asarray(ITEMS),
        observed=np.asarray(OBSERVED).tolist(),
        mask=np.asarray(MASK).tolist(),
        dt=[1, 1, 1, 1],
    )
    np.testing.assert_array_equal(plain.mean, expected.mean)
    np.testing.assert_array_equal(plain.covariance, expected.covariance)
    np.testing.assert_array_equal(run(dt=1).mean, expected.mean)
    np.testing.assert_array_equal(run(dt=jnp.asarray(1.0)).mean, expected.mean)
    assert not np.allclose(run(dt=2.0).mean, expected.mean)


def test_without_a_mask_all_is_seen_and_without_items_nothing_is_needed():
    np.testing.assert_array_equal(run(mask=None).mean, run(mask=jnp.ones((4, 3), bool)).mean)
    one = OBSERVED[:, :1]
    none = run(items=None, observed=one, mask=None)
    np.testing.assert_allclose(none.mean, run(items=jnp.zeros(1), observed=one, mask=None).mean, rtol=1e-12)


def test_robust_weights_bring_their_own_number_of_passes():
    robust = Robust(gate=10.8, passes=7)
    np.testing.assert_array_equal(run(robust=robust).mean, run(robust=robust, passes=7).mean)
    np.testing.assert_array_equal(run().mean, run(passes=4).mean)


def test_a_leaf_given_as_a_number_is_an_array():
    changed = dataclasses.replace(CAMERA, fx=510.0)
    assert changed.fx.dtype == CAMERA.fx.dtype
    settings = dataclasses.replace(Settings.of(CAMERA), sigma=1e-3)
    assert Odometry(CAMERA, settings).settings.sigma.shape == ()
    np.testing.assert_array_equal(run(dataclasses.replace(MODEL, sigma=0.1)).mean, run().mean)


def test_values_are_not_looked_at_where_there_are_none():
    def loss(sigma):
        return jnp.sum(run(Ramp(sigma)).mean)

    assert np.isfinite(jax.jit(jax.grad(loss))(0.1))
    assert np.isnan(jax.jit(loss)(jnp.nan)) or np.isfinite(jax.jit(loss)(jnp.nan))  # no error under jit


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_belief_says_how_precise_a_run_is(dtype):
    belief = jax.tree.map(lambda x: x.astype(dtype), PRIOR)
    found = run(Ramp(jnp.asarray(0.1)), belief, np.asarray(ITEMS), np.asarray(OBSERVED), np.asarray(MASK))
    assert found.mean.dtype == found.covariance.dtype == dtype


def test_pixels_where_normalised_points_belong_are_warned_of():
    model = Images(jnp.asarray(1e-3))
    with pytest.warns(UnitsWarning, match="observed has values like 3"):
        run(model, observed=OBSERVED + 300)
    with pytest.warns(UnitsWarning, match=r"model.sigma is 0.4.*noise_px / focal length"):
        run(Images(jnp.asarray(0.4)))
    with pytest.warns(UnitsWarning, match="give pixels, not normalised points"):
        Odometry(CAMERA).add(np.random.default_rng(0).uniform(-0.5, 0.5, (30, 2)), np.ones(30, bool), 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(model)
        run(observed=OBSERVED + 300)  # of another kind: metres, say


@pytest.mark.parametrize("door", [lambda b: Odometry(CAMERA, base=b), StartSettings.of, Base])
def test_a_base_may_be_a_word_and_no_other_word(door):
    door("tracks")
    with pytest.raises(InputError, match="base is 'trakcs'; choose one of 'tracks', 'inherit', 'paper'"):
        door("trakcs")
    assert Odometry(CAMERA, base="paper").base is Base.PAPER


@pytest.mark.parametrize("value", [0.0, -0.4, np.nan, np.inf])
def test_noises_and_focal_lengths_are_positive(value):
    with pytest.raises(InputError, match="noise_px is"):
        Settings.of(CAMERA, noise_px=value)
    with pytest.raises(InputError, match="calibration is"):
        Settings.of(CAMERA, calibration=value - 0.1 if value == 0 else value)
    with pytest.raises(InputError, match=r"settings.sigma is"):
        Odometry(CAMERA, dataclasses.replace(Settings.of(CAMERA), sigma=value))
    with pytest.raises(CameraError, match="fx is"):
        dataclasses.replace(CAMERA, fx=value)
    with pytest.raises(CameraError, match="fy is"):
        Camera.from_parameters(500, value, 320, 240)
    with pytest.raises(InputError, match="sigma is"):
        two_view.refine(jnp.ones(3), SO3.identity(), jnp.zeros((9, 2)), jnp.zeros((9, 2)), jnp.ones(9, bool), value)


def test_settings_want_a_pass():
    with pytest.raises(InputError, match="passes is 0"):
        Robust(passes=0)
    with pytest.raises(InputError, match="passes is 0"):
        Settings.of(CAMERA, passes=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pixels": np.zeros((3, 5))}, r"pixels has shape \(3, 5\); give \(t, n, 2\)"),
        ({"visible": np.ones((3, 4), bool)}, r"visible has shape \(3, 4\); give \(3, 5\)"),
        ({"visible": np.ones((3, 5))}, "visible holds float64 numbers; give booleans"),
        ({"times": [0.0, 1.0]}, r"times has shape \(2,\); give \(3,\)"),
        ({"times": [0.0, 1.0, 1.0]}, r"frame 2: its time 1.0 does not follow 1.0"),
        ({"times": [0.0, np.nan, 1.0]}, "frame 1: its time nan"),
        ({"pixels": np.zeros((1, 5, 2)), "visible": np.ones((1, 5), bool)}, "at least two"),
        ({"pixels": [["x"]]}, "pixels is no array of numbers"),
    ],
)
def test_tracks_that_cannot_be_followed_are_named(change, message):
    arguments = {"pixels": 100 + np.zeros((3, 5, 2)), "visible": np.ones((3, 5), bool)} | change
    with pytest.raises(InputError, match=message):
        follow_tracks(CAMERA, **arguments)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"ids": [0, 1, 1]}, "two visible tracks have the number 1"),
        ({"ids": [0, 1, -1]}, "is negative"),
        ({"ids": [0, 1]}, r"ids has shape \(2,\); give \(3,\)"),
        ({"quality": np.zeros(3)}, r"quality has shape \(3,\); give \(3, 2\)"),
    ],
)
def test_a_frame_that_cannot_be_taken_takes_nothing(more, message):
    odometry = Odometry(CAMERA, capacity=3)
    with pytest.raises(InputError, match=message):
        odometry.add(100 + np.zeros((3, 2)), [True] * 3, 0.0, **more)
    with pytest.raises(InputError, match="there is room for 3"):
        odometry.add(100 + np.zeros((4, 2)), [True] * 4, 0.0)
    assert odometry.poses == []
    assert odometry.latest is None
    with pytest.raises(InputError, match="capacity is 0"):
        Odometry(CAMERA, capacity=0)


@pytest.mark.parametrize("parameters", [lambda m: m.sigma, {"sigma": lambda m: m.sigma}, [1]])
def test_a_fit_wants_its_parameters_by_name(parameters):
    with pytest.raises(InputError, match=r"parameters.*tuning.Parameter\(lambda model: model.sigma\)"):
        tuning._parameters(parameters)  # of `fit`, whose annotations are checked before under test


def test_the_considering_filter_has_the_same_doors():
    belief = schmidt.ConsiderBelief(jnp.zeros(2), -jnp.eye(2), jnp.zeros((2, 3, 1)))
    with pytest.raises(InputError, match=r"belief.own has a negative eigenvalue"):
        schmidt.predict(MODEL, belief)


def test_a_model_of_pixels_is_noticed_where_it_is_used():
    zero = jnp.zeros(())
    model = Trifocal(0.4, zero, zero, zero, jnp.ones(3))
    assert model.sigma.shape == ()
    assert model.normalised
