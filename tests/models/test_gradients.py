"""Gradients of whole filter runs: reverse mode, forward mode and central differences agree, and none is NaN.

Compiling a reverse derivative takes most of the time, so each run is compiled once, for all of its scenes, and
its values are those that come with the derivative. Those that take longest run with JAXTRI_ALL_GRADIENTS set.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float
from scipy.spatial.transform import Rotation

from jaxtri.estimation.two_view import TwoView
from jaxtri.filters import ekf, schmidt
from jaxtri.filters.linalg import regression
from jaxtri.geometry.pose import compose
from jaxtri.models import base_frames, trifocal
from jaxtri.models.base_frames import BaseFrames
from jaxtri.models.baselines import structure_and_motion as sam
from jaxtri.models.baselines import two_step
from jaxtri.models.depth import Depth
from jaxtri.models.trifocal import DEFAULT, PAPER, Trifocal
from jaxtri.odometry import track_pairs

N, FRAMES, SIGMA = 12, 6, 1e-3
OUTLIER, ENDS, NEVER = 3, 5, 7  # points


class Data(NamedTuple):
    """What a run is given; the first two frames are a base pair."""

    observed: Float[Array, "t n 2"]
    mask: Bool[Array, "t n"]
    view: TwoView
    world: SE3  # pose of the first frame


def scene(turn=(0.01, -0.03, 0.02), world=(0.0, 0.0, 0.0), noise=SIGMA, moving=FRAMES, same=1):
    """A camera that moves at constant velocity for `moving` frames, before points of which the first `same` are one.

    One observation is an outlier, one track ends, one is never seen, and the last frame is blank.
    """
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -0.8, 1.8], [1, 0.8, 3.5], (N, 3))
    noises = noise * rng.normal(size=(FRAMES, N, 2))
    points[:same], noises[:, :same] = points[0], noises[:, :1]
    shift = np.array([0.12, 0.03, -0.04])
    t = np.minimum(np.arange(FRAMES), moving)[:, None]
    R = Rotation.from_rotvec(t * np.array(turn)).as_matrix()
    X = np.einsum("tij,nj->tni", R, points) + t[:, None] * shift
    observed = X[..., :2] / X[..., 2:] + noises
    observed[3, OUTLIER] += 20 * SIGMA
    mask = np.ones((FRAMES, N), bool)
    mask[3:, ENDS] = mask[:, NEVER] = mask[-1] = False
    n = shift / np.linalg.norm(shift)
    C = np.diag([1e-5] * 3 + [2e-6] * 3)
    C[:3, :3] -= 1e-5 * np.outer(n, n)
    view = TwoView(jnp.asarray(shift), SO3.exp(jnp.array(turn)), jnp.asarray(C), jnp.ones(()), jnp.asarray(True))
    return Data(jnp.asarray(observed), jnp.asarray(mask), view, compose(SO3.exp(jnp.array(world)), jnp.zeros(3)))


STILL, HALF_A_TURN = (0.0, 0.0, 0.0), (0.0, 0.0, np.pi - 1e-3)
PLAIN = scene()
SMOOTH = {
    "zero rotation": scene(STILL, noise=0.0),
    "stops": scene(STILL, noise=0.0, moving=1),
    "half a turn": scene(HALF_A_TURN, HALF_A_TURN),  # between the base frames, of the pose, and of the world
    "coincident points": scene(same=3),
}
KINKED = {"static": scene(STILL, noise=0.0, moving=0), "one point": scene(same=N)}


def priors(p):
    return {k: p[k] for k in ("velocity_sd", "angular_velocity_sd")}


def noises(p):
    return p["sigma"], p["acceleration"], p["angular_acceleration"]


def robust(p):
    return ekf.Robust(p["robust_start"], p["robust_scale"], jnp.asarray(13.8))


def at(tree, frame):
    return jax.tree.map(lambda x: x[frame], tree)


def pairs(d):
    return jnp.concatenate([d.observed[0], d.observed[1]], axis=-1)


def weighed(tree):
    """One number of many."""
    numbers = jnp.concatenate([x.ravel() for x in jax.tree.leaves(tree)])
    return 100 * numbers @ np.random.default_rng(1).normal(size=numbers.size)


def cost(says, mean, covariance):
    """The negative log-likelihood, and a belief, of which it may know nothing."""
    return -jnp.sum(says.log_likelihood) + weighed(mean) + 10 * jnp.log(jnp.trace(covariance))


def of_bank(bank, d):
    known = d.mask[0]
    variance = jnp.where(known, bank.covariance[:, 0, 0], 0.0)
    return weighed(jnp.where(known, bank.parameter, 0.0)) + 10 * jnp.log(jnp.sum(variance))


def one_pair(mode, p, d, smooth=False):
    belief = trifocal.start(d.view, euler=mode.euler, **priors(p))
    model = Trifocal(
        *noises(p), p["base_drift"], d.view.translation, base_noise=mode.base_noise, refine_base=mode.refine_base
    )
    weights = robust(p) if "robust_scale" in p else None
    beliefs, says = ekf.filter(model, belief, pairs(d), d.observed[2:], d.mask[2:], passes=mode.passes, robust=weights)
    there = at(ekf.smooth(model, beliefs), 0) if smooth else at(beliefs, -1)
    return cost(says, there.mean, there.covariance)


def consistent(p, d):
    belief = trifocal.consistent_start(d.view, pairs(d), d.mask[1], p["sigma"], **priors(p))
    model = Trifocal(*noises(p), p["base_drift"], d.view.translation)
    beliefs, says = schmidt.filter(model, belief, pairs(d), d.observed[2:], d.mask[2:], robust=robust(p))
    there = at(beliefs, -1)
    return cost(says, there.mean, there.covariance)


def many_bases(p, d):
    """The third frame becomes a base frame, and the fifth in its place."""
    model = BaseFrames(*noises(p))
    belief = base_frames.start(d.view, d.observed[0], d.observed[1], d.mask[1], p["sigma"], 3, **priors(p))

    def body(belief, frame):
        z, seen, base = frame
        return base_frames.step(model, belief, z, seen, base, jnp.asarray(1), robust=robust(p))

    frames = d.observed[2:], d.mask[2:], jnp.array([True, False, True, False])
    belief, says = jax.lax.scan(body, belief, frames)
    mean, whole = belief.mean, schmidt.total(model, belief, None)
    known = jnp.where(d.mask[0][:, None], mean.points.point, 0.0)
    return cost(says, (mean.motion, mean.bases, known), whole.covariance)


def full(p, d):
    model = sam.StructureAndMotion(*noises(p))
    belief = sam.two_view_start(d.view, d.observed[0], d.observed[1], p["sigma"], **priors(p))
    items = sam.sights(d.observed[0])
    beliefs, says = ekf.filter(model, belief, items, d.observed[2:], d.mask[2:], robust=robust(p))
    there = at(beliefs, -1)
    return cost(says, there.mean, there.covariance)


def full_planar(p, d):
    """Of their day, but smoothed, and with a focal length to be found."""
    model = sam.StructureAndMotion(*noises(p), ray_noise=False)
    sds = {k: p[k] for k in ("relative_sd", "focal_sd")}
    belief = sam.planar_start(d.observed[0], p["z_init"], **sds, **priors(p))
    items = sam.sights(d.observed[0])
    beliefs, says = ekf.filter(model, belief, items, d.observed[1:], d.mask[1:], passes=1)
    there = at(ekf.smooth(model, beliefs), 0)
    return cost(says, there.mean, there.covariance)


def two_steps(p, d):
    depth = Depth(p["sigma"], p["ray_sigma"], p["drift"], jnp.asarray(jnp.inf))
    model = two_step.TwoStep(two_step.KnownStructure(*noises(p)), depth)
    belief = two_step.two_view_start(model, d.view, d.observed[0], d.observed[1], **priors(p))
    beliefs, says = two_step.filter(model, belief, d.observed[2:], d.mask[2:], robust=robust(p))
    there = at(beliefs, -1)
    return cost(says, there.camera.mean, there.camera.covariance) + of_bank(there.bank, d)


def two_steps_planar(p, d):
    depth = Depth.paper(p["sigma"], drift=p["drift"])
    model = two_step.TwoStep(two_step.KnownStructure(*noises(p), structure_noise=False), depth)
    belief = two_step.planar_start(model, d.observed[0], p["z_init"], relative_sd=p["relative_sd"], **priors(p))
    beliefs, says = two_step.filter(model, belief, d.observed[1:], d.mask[1:], passes=1)
    there = at(beliefs, -1)
    return cost(says, there.camera.mean, there.camera.covariance) + of_bank(there.bank, d)


def per_track(p, d):
    weights = ekf.Robust(p["robust_start"], p["robust_scale"], p["gate"])
    settings = {k: v for k, v in p.items() if k not in ("robust_start", "robust_scale", "gate")}
    settings = track_pairs.Settings(**settings, correlation=0.9, calibration=0.0, robust=weights)
    pose = compose(d.view.rotation, d.view.translation)
    state = track_pairs.init(settings, d.observed[0], d.observed[1], d.mask[1], pose, world=d.world, keyframes=4)
    dt, mask = jnp.array([2.0, 1.0, 1.0, 1.0]), d.mask[2:]
    state, report = track_pairs.filter(settings, state, d.observed[2:], mask, jnp.zeros_like(mask), dt)
    there = at(report, -1)
    known = jnp.where(jnp.any(state.window.mask, axis=0), state.window.X, 0.0)
    return cost(report.diagnostics, (there.pose, known), there.covariance)


@dataclass(frozen=True)
class Run:
    """A number that a filter run ends in, and the parameters, all positive, that it is differentiated by."""

    cost: Callable[[dict[str, Array], Data], Array]
    parameters: dict[str, float]
    thresholds: dict[str, float] = field(default_factory=dict)  # which only decide: the derivative is zero
    masked_start: bool = True  # the start, too, leaves masked points out
    forward: bool = False
    slow: bool = False


NOISES = {"sigma": SIGMA, "acceleration": 0.01, "angular_acceleration": 0.01}
USUAL = NOISES | {"velocity_sd": 0.02, "angular_velocity_sd": 0.03}
DRIFT = {"base_drift": 1e-3}
PLANE = {"z_init": 2.5, "relative_sd": 0.3}
ROBUST = {"robust_start": 1e4, "robust_scale": 16.0}
KEYFRAMES = {"keyframe_flow": 0.05, "keyframe_common": 4.0, "keyframe_usable": 0.3, "patience": 15.0, "minimum": 5.0}
GATES = {"usable_parallax": 0.005, "fixed_parallax": 0.05, "epipolar_gate": 0.01, "outlier": 30.0, "gate": 13.8}
RUNS = {
    "default": Run(partial(one_pair, DEFAULT), USUAL | DRIFT | ROBUST),
    "paper": Run(partial(one_pair, PAPER), USUAL | DRIFT, forward=True),
    "full, planar": Run(full_planar, USUAL | PLANE | {"focal_sd": 0.05}),
    "two steps, planar": Run(two_steps_planar, USUAL | PLANE | {"drift": 0.01}),
    "consistent": Run(consistent, USUAL | DRIFT | ROBUST, forward=True, slow=True),
    "smoothed": Run(partial(one_pair, DEFAULT, smooth=True), USUAL | DRIFT, slow=True),
    "full": Run(full, USUAL | ROBUST, masked_start=False, slow=True),
    "two steps": Run(two_steps, USUAL | ROBUST | {"ray_sigma": SIGMA, "drift": 0.01}, slow=True),
    "per track": Run(per_track, NOISES | ROBUST, KEYFRAMES | GATES, forward=True, slow=True),
    "many bases": Run(many_bases, USUAL | ROBUST, slow=True),
}
SLOW = pytest.mark.skipif("JAXTRI_ALL_GRADIENTS" not in os.environ, reason="minutes of compilation")


def cases(*scenes):
    found = []
    for name, run in RUNS.items():
        for s in scenes:
            # A camera that starts at rest does not follow one that turns over in every frame.
            if s == "half a turn" and "planar" in name:
                continue
            found.append(pytest.param(name, s, marks=[SLOW] if run.slow else [], id=f"{name}-{s}"))
    return found


@cache
def compiled(name):
    """The cost with its gradient, and its derivative in a direction, at a point and a scene."""

    def f(x, d):
        T, R = d.view.translation + x["pose"][:3], SO3.exp(x["pose"][3:]) @ d.view.rotation
        C = jnp.exp(2 * x["pose_sd"]) * d.view.covariance
        view = TwoView(T, R, C, d.view.rms, d.view.converged)
        return RUNS[name].cost(jax.tree.map(jnp.exp, x["log"]), d._replace(observed=x["observed"], view=view))

    return jax.jit(jax.value_and_grad(f)), jax.jit(lambda x, dx, d: jax.jvp(lambda y: f(y, d), (x,), (dx,))[1])


def point(name, d):
    """Where to differentiate: logarithms of parameters, image points, and the two-view pose and its precision."""
    run = RUNS[name]
    log = {k: jnp.asarray(np.log(v)) for k, v in (run.parameters | run.thresholds).items()}
    return {"log": log, "observed": d.observed, "pose": jnp.zeros(6), "pose_sd": jnp.zeros(())}


def directions(name, d):
    """One for each parameter, and at random for the rest; each a change of about one standard deviation."""
    x, rng = point(name, d), np.random.default_rng(2)
    zero = jax.tree.map(jnp.zeros_like, x)
    found = {k: zero | {"log": zero["log"] | {k: jnp.ones(())}} for k in x["log"]}
    if "planar" not in name:
        if name != "per track":  # it works out how precise its start is
            found["pose_sd"] = zero | {"pose_sd": jnp.ones(())}
        found["pose"] = zero | {"pose": jnp.asarray(1e-3 * rng.normal(size=6))}
    noise = SIGMA * rng.normal(size=d.observed.shape)
    for k, rows in (("first points", slice(0, 2)), ("later points", slice(2, None))):
        found[k] = zero | {"observed": zero["observed"].at[rows].set(noise[rows])}
    return found


def inner(a, b):
    return sum(np.vdot(p, q) for p, q in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def central(name, d, dx, h=1e-4):
    value, _ = compiled(name)
    x = point(name, d)
    up, down = (value(jax.tree.map(lambda a, b, s=s: a + s * b, x, dx), d)[0] for s in (h, -h))
    return (up - down) / (2 * h)


def assert_finite(tree):
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


@pytest.mark.parametrize(("name", "where"), cases("plain"))
def test_gradient_by_every_parameter(name, where):
    run, d = RUNS[name], PLAIN
    gradient, along = compiled(name)
    x = point(name, d)
    _, slopes = gradient(x, d)
    assert_finite(slopes)
    dxs = directions(name, d)
    reverse = {k: inner(slopes, dx) for k, dx in dxs.items()}
    scale = float(np.linalg.norm(list(reverse.values())))
    for k, dx in dxs.items():
        if k in run.thresholds:
            assert reverse[k] == 0
        else:
            assert reverse[k] != 0
        np.testing.assert_allclose(reverse[k], central(name, d, dx), rtol=1e-5, atol=1e-7 * scale, err_msg=k)
        if run.forward:
            np.testing.assert_allclose(reverse[k], along(x, dx, d), rtol=1e-9, atol=1e-10 * scale, err_msg=k)


@pytest.mark.parametrize(("name", "where"), cases(*SMOOTH))
def test_gradient_at_degenerate_scenes(name, where):
    d = SMOOTH[where]
    _, slopes = compiled(name)[0](point(name, d), d)
    assert_finite(slopes)
    dxs = directions(name, d)
    scale = float(np.linalg.norm([inner(slopes, dx) for dx in dxs.values()]))
    # All parameters at once, then all that is geometry.
    for some in (RUNS[name].parameters, dxs.keys() - RUNS[name].parameters.keys() - RUNS[name].thresholds.keys()):
        dx = jax.tree.map(lambda *x: sum(x[1:], x[0]), *(dxs[k] for k in sorted(some)))
        np.testing.assert_allclose(inner(slopes, dx), central(name, d, dx), rtol=1e-5, atol=1e-7 * scale)


@pytest.mark.parametrize(("name", "where"), cases(*KINKED))
def test_gradient_where_there_is_none_is_finite(name, where):
    """Of a base pair without parallax, and of a scene without extent."""
    d = KINKED[where]
    assert_finite(compiled(name)[0](point(name, d), d))


@pytest.mark.parametrize(("name", "where"), cases("junk"))
def test_what_is_masked_has_no_part_in_the_gradient(name, where):
    masked = ~np.asarray(PLAIN.mask)
    if not RUNS[name].masked_start:
        masked[:2] = False
    junk = np.where(np.arange(FRAMES * N).reshape(FRAMES, N) % 2, np.nan, 1e30)
    filled = PLAIN._replace(observed=jnp.where(masked[..., None], junk[..., None], PLAIN.observed))
    assert np.isnan(filled.observed).any()
    assert np.any(filled.observed == 1e30)
    gradient, _ = compiled(name)
    expected, found = (gradient(point(name, d), d) for d in (PLAIN, filled))
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert not np.any(found[1]["observed"][masked])
    if name != "per track":  # which leaves out pairs that disagree
        assert np.all(found[1]["observed"][PLAIN.mask] != 0)


def test_regression_gives_no_weight_to_what_is_known():
    """A direction without uncertainty, across the axes: what is divided there is rounding by rounding."""
    rng, d = np.random.default_rng(0), 18
    n, A, F = rng.normal(size=d), rng.normal(size=(d, d)), rng.normal(size=(d, d))
    n /= np.linalg.norm(n)
    A -= np.outer(n, n @ A)
    P = jnp.asarray(A @ A.T)
    G = regression(P, P @ F.T)
    sd = np.sqrt(np.diagonal(P))
    assert np.abs(G * sd @ (n * sd)).max() < 1e-6 * np.abs(G * sd).max()
    np.testing.assert_allclose(G @ A, F @ A, atol=1e-9 * np.abs(F @ A).max())
