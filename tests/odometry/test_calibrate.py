from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2
from tracks import make

from jaxtri.errors import InitialisationError, InputError, InputWarning
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.lenses import BrownConrady
from jaxtri.odometry.calibrate import UNMODELLED, calibrate
from jaxtri.odometry.refine import refine
from jaxtri.odometry.run import follow_tracks
from jaxtri.odometry.settings import Settings, Status
from jaxtri.trajectory import Trajectory, evaluate

FRAMES, K1 = 40, -0.15


@jax.jit
def seen_by(camera, other, pixels):
    return camera.to_pixels(other.to_normalised(pixels))


def around(noise_px, seed=0, k1=K1):
    """Tracks of an arc of 45 degrees around the scene, seen through a lens; and the camera."""
    a = np.linspace(0, np.pi / 4, FRAMES)[:, None]
    zero = np.zeros_like(a)
    centres = np.hstack([4 * np.sin(a), 0.3 * np.sin(4 * a), 4 - 4 * np.cos(a)])
    tracks = make(centres, np.hstack([zero, -a, zero]), noise_px=0.0, seed=seed)
    camera = replace(tracks.camera, distortion=BrownConrady.from_coefficients([k1]))
    pixels = np.array(seen_by(camera, tracks.camera, jnp.asarray(tracks.pixels)))
    pixels += np.random.default_rng(seed).normal(scale=noise_px, size=pixels.shape)
    return tracks._replace(camera=camera, pixels=pixels)


def followed(tracks, focal, correlation=0.9, zoom=None):
    guess = Camera.from_parameters(focal, focal, 320, 240, width=640, height=480)
    settings = eqx.tree_at(lambda s: s.correlation, Settings.of(guess), jnp.asarray(correlation, float))
    return follow_tracks(guess, tracks.pixels, tracks.visible, settings=settings, zoom=zoom, record=True)


def zooming(tracks, ratio):
    """What the camera sees whose focal length is so many times its own in each frame."""
    centre = np.array([320, 240])
    return tracks._replace(pixels=centre + ratio[:, None, None] * (tracks.pixels - centre))


@pytest.mark.parametrize("share", [0.8, 1.25])
def test_exact_tracks_give_the_camera_back(share):
    tracks = around(0.0)
    found = calibrate(followed(tracks, share * 500))
    lens = found.camera.distortion
    assert lens is not None
    np.testing.assert_allclose(found.camera.fx, 500, rtol=1e-3)
    np.testing.assert_allclose(found.camera.fy, found.camera.fx)
    np.testing.assert_allclose([found.camera.cx, found.camera.cy], [320, 240], atol=1.0)
    np.testing.assert_allclose(lens.coefficients[:2], [K1, 0], atol=5e-3)
    assert found.determined
    assert found.zoom is None
    assert found.statistics()["focal_length_px"] == round(float(found.camera.fx), 3)
    # How far a camera sees what another one does at the edge: none, and a zoom by it.
    assert found.shift(found.camera) < 1e-9
    wider = replace(found.camera, fx=found.camera.fx * 1.02, fy=found.camera.fy * 1.02)
    assert found.shift(wider) == pytest.approx(0.02, rel=0.05)
    assert found.shift(replace(wider, cx=wider.cx + 9)) == found.shift(wider)
    fish = replace(wider, distortion=BrownConrady.from_coefficients([-0.9]))  # has no ray for the edge
    assert replace(found, camera=fish).shift(fish) == 0


def test_a_zoom_on_the_way_is_found_and_followed():
    """By half of the focal length, in the middle of the way; nothing but a guess is known of the camera."""
    ratio = 1.5 ** np.clip((np.arange(FRAMES) - 10) / 20, 0, 1)
    tracks = zooming(around(0.3, k1=0.0), ratio)
    truth = Trajectory(np.arange(FRAMES, dtype=float), tracks.T_world_camera)
    first, fixed = calibrate(followed(tracks, 450)), followed(tracks, 500)
    assert first.zoom is not None
    # Once more, as `track_uncalibrated` does: by keyframes that are closer to each other.
    found = calibrate(followed(tracks, float(first.camera.fx), zoom=first.zoom))
    assert found.zoom is not None
    odometry = followed(tracks, float(found.camera.fx), zoom=found.zoom)
    focal = np.array([float(odometry.camera_at(float(t)).fx) for t in range(FRAMES)])
    np.testing.assert_allclose(focal, 500 * ratio, rtol=0.04)
    np.testing.assert_allclose(focal / focal[0], ratio, atol=3 * found.zoom.sd.max())
    known, unknown = (evaluate(o.trajectory(), truth).ate_percent for o in (odometry, fixed))
    assert known < 0.1 * unknown
    zoom = found.statistics()["zoom"]
    assert isinstance(zoom, dict)
    np.testing.assert_allclose(zoom["focal_length_px"][-1], 750, rtol=0.04)
    with pytest.raises(InputError, match="one focal length"):
        odometry.recording()
    refined = refine(odometry)  # which knows of it, and doubts nothing
    assert {p.status for p in refined.poses} == {Status.TRACKING}
    # A camera that should not zoom is doubted from there on, with the reason.
    with pytest.warns(InputWarning, match=r"zooms from frame 1?\d on, to 1.[45]\d times"):
        doubted = refine(fixed)
    begun = next(k for k, p in enumerate(doubted.poses) if p.status is Status.UNCERTAIN)
    assert 8 <= begun < 15
    assert all(p.status is Status.UNCERTAIN for p in doubted.poses[begun:])
    assert "times the focal length of the first frame" in doubted.poses[-1].doubts[-1]


def test_its_standard_deviation_is_that_of_the_errors():
    """Of the focal length and of k1, over noises; what no track shows is taken off."""
    z = []
    for seed in range(8):
        tracks = around(0.4, seed=seed)
        found = calibrate(followed(tracks, 500, correlation=0.0))
        lens = found.camera.distortion
        assert lens is not None
        own = np.sqrt(found.focal_sd**2 - UNMODELLED**2)
        z.append([np.log(float(found.camera.fx) / 500) / own, (lens.coefficients[0] - K1) / found.radial_sd[0]])
    squares = (np.array(z) ** 2).sum(axis=0)
    assert (squares < chi2.ppf(0.9995, 8)).all()
    assert (squares > chi2.ppf(0.0005, 8)).all()


def test_a_camera_that_only_slides_does_not_determine_it():
    t = np.arange(FRAMES)[:, None]
    tracks = make(t * [0.03, 0.002, 0.0], t * [0.0, 0.0, 0.0], noise_px=0.3)
    found = calibrate(followed(tracks, 400))
    assert not found.determined
    assert found.focal_sd < 0.6  # what was known beforehand


def test_what_was_known_beforehand_counts():
    tracks = around(0.4)
    odometry = followed(tracks, 500)
    given = Camera.from_parameters(510, 510, 320, 240, width=640, height=480)
    kept = calibrate(odometry, guess=given, prior=1e-5)
    np.testing.assert_allclose(kept.camera.fx, 510, rtol=1e-3)
    assert kept.focal_sd == pytest.approx(UNMODELLED, rel=1e-3)


def test_it_needs_tracks_and_a_motion():
    tracks = around(0.3)
    with pytest.raises(InputError, match="record=True"):
        calibrate(follow_tracks(tracks.camera, tracks.pixels[:5], tracks.visible[:5]))
    with pytest.raises(InitialisationError):
        calibrate(follow_tracks(tracks.camera, tracks.pixels[:1].repeat(5, 0), tracks.visible[:5], record=True))
