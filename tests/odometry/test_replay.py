import dataclasses
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from tracks import sideways

from jaxtri.errors import InitialisationError, InputError
from jaxtri.filters.diagnostics import Diagnostics
from jaxtri.filters.scan import checkpointed
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.lenses import BrownConrady
from jaxtri.models.point_noise import PointNoise
from jaxtri.odometry import replay
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.run import follow_tracks
from jaxtri.odometry.settings import Base, Report, Settings, StartSettings

TRACKS = sideways(16, seed=1)
SETTINGS = Settings.of(TRACKS.camera, noise_px=0.3)


@cache
def live(base, overlap=1):
    """A run of the driver, restarted once where one pair serves all, and its recording."""
    start = dataclasses.replace(StartSettings.of(base), restart=0.94, overlap=overlap)
    odometry = follow_tracks(
        TRACKS.camera, TRACKS.pixels, TRACKS.visible, base=base, settings=SETTINGS, start=start, record=True
    )
    assert odometry.changes == (base is not Base.TRACKS)
    return odometry, odometry.recording()


def told(x):
    """Camera and settings: focal length, noises and robust scale multiplied by exp(x), a lens, noise by quality."""
    f, lens, added = jnp.exp(x[:5]), BrownConrady(jnp.pad(x[5:10], (0, 3))), PointNoise(x[10], x[11])
    camera = dataclasses.replace(TRACKS.camera, fx=TRACKS.camera.fx * f[0], fy=TRACKS.camera.fy * f[0], distortion=lens)

    def tuned(s):
        return s.sigma, s.acceleration, s.angular_acceleration, s.robust.scale

    settings = eqx.tree_at(tuned, SETTINGS, tuple(x * y for x, y in zip(tuned(SETTINGS), f[1:], strict=True)))
    return camera, dataclasses.replace(settings, point_noise=added)


def agrees(odometry, recording, report):
    """Whether a replay says of its frames what the driver said."""
    measured = np.asarray(recording.frames)
    if report.covariance.ndim == 3:
        measured = np.arange(1, len(recording.pixels))
    said = [odometry.poses[odometry.base_pair[0] + k] for k in measured[measured >= 0]]
    poses, covariances = (np.asarray(x)[measured >= 0] for x in (report.pose.as_matrix(), report.covariance))
    np.testing.assert_allclose(poses, np.stack([p.T_camera_world for p in said]), atol=1e-9)
    np.testing.assert_allclose(covariances, np.stack([p.covariance for p in said]), atol=1e-11)


@jax.jit
def of_tracks(x, recording):
    """The likelihood of a replay, its slope by the log of the noise, in forward mode, and its reports."""

    def loss(x):
        settings = eqx.tree_at(lambda s: s.sigma, SETTINGS, SETTINGS.sigma * jnp.exp(x))
        report = replay.tracks(TRACKS.camera, settings, recording)
        return replay.negative_log_likelihood(TRACKS.camera, recording, report), report

    return jax.jvp(loss, (x,), (jnp.ones(()),), has_aux=True)


def test_a_replay_of_tracks_is_the_run():
    odometry, recording = live(Base.TRACKS)
    agrees(odometry, recording, of_tracks(jnp.zeros(()), recording)[2])


def test_a_replay_of_pairs_is_the_run():
    odometry, recording = live(Base.INHERIT)
    agrees(odometry, recording, jax.jit(replay.pairs)(TRACKS.camera, SETTINGS, recording))


@pytest.mark.as_users
def test_the_slope_by_the_noise_is_that_of_differences():
    """In forward mode, as one number is fitted."""
    _, recording = live(Base.TRACKS)
    at, h = 0.5, 1e-5  # a noise too large, where there is a slope
    (down, *_), (_, slope, _), (up, *_) = (of_tracks(jnp.zeros(()) + at + x, recording) for x in (-h, 0, h))
    np.testing.assert_allclose(slope, (up - down) / (2 * h), rtol=1e-5)
    assert slope > 0.1


def test_the_gradient_through_a_restart_is_that_of_differences():
    """With the hand-over of the scale, from the intrinsics to the poses and the likelihood."""
    odometry, recording = live(Base.PAPER, overlap=2)
    rng = np.random.default_rng(0)
    quality = np.exp(0.5 * rng.normal(size=recording.quality.shape)) * [0.1, 0.03]
    recording = dataclasses.replace(recording, quality=jnp.asarray(quality))

    def loss(x):
        camera, settings = told(x)
        report = replay.pairs(camera, settings, recording)
        return replay.negative_log_likelihood(camera, recording, report), report

    value = jax.jit(jax.value_and_grad(loss, has_aux=True))
    (_, report), slope = value(jnp.zeros(12))
    agrees(odometry, recording, report)
    h = 2e-5
    differences = [(value(s)[0][0] - value(-s)[0][0]) / (2 * h) for s in h * jnp.eye(12)]
    np.testing.assert_allclose(slope, differences, atol=1e-5 * np.linalg.norm(differences))
    assert (np.abs(differences) > 1e-4 * np.linalg.norm(differences)).all()


def test_likelihoods_are_those_of_pixels():
    """By the change of variables, through distortion too; what a gate leaves out is drawn evenly from the image."""
    lens = BrownConrady.from_coefficients([-0.2, 0.05, 0.001, -0.002])
    camera = Camera.from_parameters(500, 520, 320, 240, width=640, height=480, distortion=lens)
    rng = np.random.default_rng(0)
    pixels = jnp.asarray(rng.uniform(100, 400, (3, 5, 2)))
    _, recording = live(Base.TRACKS)
    visible = np.ones((3, 5), bool)
    visible[1, 4] = False
    recording = eqx.tree_at(lambda r: (r.pixels, r.visible), recording, (pixels, jnp.asarray(visible)))
    weights = jnp.asarray([[1.0, 0.5, 0.0, 1.0, 0.0], [1.0, 1.0, 1.0, 1.0, 1.0]])

    @jax.jit
    def reported():
        said = jax.vmap(Diagnostics)(
            jnp.asarray([30.0, 40.0]), jnp.zeros(2), jnp.asarray([4, 5]), jnp.asarray([3, 5]), weights, weights
        )
        pose, none = SE3.identity((2,)), jnp.zeros(2, bool)
        dropped = jnp.zeros((2, 5), bool)
        zero = jnp.zeros(2)
        return Report(pose, jnp.zeros((2, 6, 6)), jnp.ones(2, int), none, zero, dropped, said, jnp.ones(2), dropped)

    report, likelihood = reported(), jax.jit(replay.negative_log_likelihood)
    jacobians = jax.jit(jax.vmap(jax.vmap(jax.jacrev(lambda x: camera.to_normalised(x)))))(pixels[1:])
    log_det = np.log(np.abs(np.linalg.det(jacobians)))[np.asarray(weights) > 0].sum()
    expected = -(70 + log_det - np.log(640 * 480)) / 18
    np.testing.assert_allclose(likelihood(camera, recording, report), expected, rtol=1e-12)
    plain = dataclasses.replace(camera, distortion=None)
    expected = -(70 - 8 * np.log(500 * 520) - np.log(640 * 480)) / 18
    np.testing.assert_allclose(likelihood(plain, recording, report), expected, rtol=1e-12)


def test_a_recording_can_be_cut_and_wants_a_start():
    _, recording = live(Base.INHERIT)
    t = int(recording.second[1])
    assert len(recording.until(t + 1).first) == 2
    short = recording.until(t)
    assert short.pixels.shape[0] == t
    assert short.frames.tolist() == [list(range(int(recording.second[0]) + 1, t))]
    with pytest.raises(InputError, match="record=True"):
        Odometry(TRACKS.camera).recording()
    still = np.broadcast_to(TRACKS.pixels[:1], (4, *TRACKS.pixels.shape[1:]))
    seen = np.broadcast_to(TRACKS.visible[:1], still.shape[:2])
    with pytest.raises(InitialisationError, match="flow"):
        follow_tracks(TRACKS.camera, still, seen, record=True).recording()


@pytest.mark.parametrize("block", [1, 3, 4, 12, 20])
def test_a_scan_in_blocks_is_a_scan(block):
    def body(carry, x):
        carry = jnp.sin(carry * x["a"]) + x["b"]
        return carry, (carry**2, jnp.sum(x["b"]))

    rng = np.random.default_rng(0)
    xs = {"a": jnp.asarray(rng.normal(size=12)), "b": jnp.asarray(rng.normal(size=(12, 3)))}

    def loss(xs, scan):
        carry, (squares, sums) = scan(body, jnp.ones(3), xs)
        return jnp.sum(carry) + jnp.sum(squares * jnp.arange(36).reshape(12, 3)) + sums @ sums

    both = jax.jit(jax.value_and_grad(loss), static_argnums=1)
    ours, theirs = both(xs, partial(checkpointed, block=block)), both(xs, jax.lax.scan)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), ours, theirs)
