"""Rows that are exposed one after the other, while a hand shakes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tracks import CAPACITY, camera, rotation

from jaxtri.errors import CameraError, InputError
from jaxtri.geometry.camera import Camera
from jaxtri.odometry.observing import steadied
from jaxtri.odometry.refine import refine
from jaxtri.odometry.run import follow_tracks
from jaxtri.trajectory import Trajectory, evaluate

FRAMES, FPS, READOUT = 60, 25.0, 0.02


def pose(seconds):
    """Rotation, world to camera, and centre: a slide with a tremor of a degree at 1 to 4 hertz."""
    t = 2 * np.pi * seconds
    turn = np.radians([np.sin(2.3 * t), np.sin(1.7 * t + 1), 0.7 * np.sin(3.1 * t + 2)])
    return rotation(-turn), np.array([1.0 * seconds, 0.02 * np.sin(2 * t), 0.1 * seconds])


def clip(axis, readout=READOUT, seed=0):
    """Pixels (t, n, 2), each of the time at which its row (axis 1) or column is read; the true poses."""
    rng, to_pixels = np.random.default_rng(seed), jax.jit(Camera.to_pixels)
    points = rng.uniform([-1.6, -1.6, 2.8], [4.0, 1.6, 5.2], (CAPACITY, 3))
    size, pixels, T = np.array([640, 480]), np.zeros((FRAMES, CAPACITY, 2)), np.tile(np.eye(4), (FRAMES, 1, 1))
    for k in range(FRAMES):
        R, centre = pose(k / FPS)
        T[k, :3, :3], T[k, :3, 3] = R.T, centre
        late = np.zeros(CAPACITY)
        for _ in range(6):  # the time at which a point is read depends on where it is then
            seen = [r @ (p - c) for p, (r, c) in zip(points, (pose(k / FPS + s) for s in late), strict=True)]
            z = np.asarray(to_pixels(camera(), jnp.asarray([x[:2] / x[2] for x in seen])))
            late = readout * ((z[:, axis] + 0.5) / size[axis] - 0.5).clip(-0.5, 0.5)
        pixels[k] = z
    visible = ((pixels > 0) & (pixels < size)).all(-1)
    return pixels + rng.normal(scale=0.2, size=pixels.shape), np.logical_and.accumulate(visible, axis=0), T


def errors(given, pixels, visible, T):
    """Causal and refined."""
    times = np.arange(FRAMES) / FPS
    run = follow_tracks(given, pixels, visible, times, record=True)
    return [evaluate(x.trajectory(), Trajectory(times, T)) for x in (run, refine(run))]


@pytest.mark.parametrize(("axis", "readout"), [(1, (0.0, READOUT)), (0, (READOUT, 0.0))], ids=["rows", "columns"])
def test_a_shutter_that_is_told_costs_little(axis, readout):
    seen = clip(axis)
    told, untold, still = (
        errors(c, *x)
        for c, x in ((camera().rolling(*readout), seen), (camera(), seen), (camera(), clip(axis, readout=0.0)))
    )
    for with_it, without, none in zip(told, untold, still, strict=True):
        assert with_it.ate_percent < 0.3 * without.ate_percent
        assert with_it.ate_percent < 1.6 * none.ate_percent
        assert with_it.rotation_rmse_deg < 0.5 * without.rotation_rmse_deg


def test_a_readout_of_none_and_of_zero_are_one():
    pixels, visible, _ = clip(1)
    times = np.arange(FRAMES) / FPS
    one, other = (follow_tracks(c, pixels, visible, times) for c in (camera(), camera().rolling(0.0, 0.0)))
    for a, b in zip(one.poses, other.poses, strict=True):
        np.testing.assert_allclose(a.T_camera_world, b.T_camera_world, atol=1e-9)


def test_points_go_back_by_their_own_flow():
    """Exact where the flow is even; what is seen once stays."""
    rng = np.random.default_rng(0)
    start, flow = rng.normal(size=(2, 5, 2))
    late = [rng.uniform(-0.4, 0.4, 5) for _ in range(3)]
    ids = [np.arange(5), np.arange(5), np.array([0, 1, 2, 3, 9])]
    index = [4, 5, 7]
    points = [(m, start + (m + d)[:, None] * flow, n) for m, d, n in zip(index, late, ids, strict=True)]
    found = steadied(points, late)
    for k, (m, z) in enumerate(zip(index, found, strict=True)):
        known = np.arange(5) < (4 if k == 2 else 5)
        np.testing.assert_allclose(z[known], (start + m * flow)[known], atol=1e-12)
        np.testing.assert_array_equal(z[~known], points[k][1][~known])


def test_a_picture_that_is_turned_is_read_the_other_way():
    rolling, seen = camera().rolling(0.0, READOUT), jnp.array([[0.0, 0.0], [639.0, 100.0], [20.0, 479.0]])
    turned = jnp.stack([479 - seen[:, 1], seen[:, 0]], axis=1)
    np.testing.assert_allclose(rolling.turned(90).late(turned), rolling.late(seen), atol=1e-12)
    np.testing.assert_allclose(rolling.scaled(320, 240).late(seen / 2 - 0.25), rolling.late(seen), atol=1e-12)
    assert float(rolling.late(jnp.array([3.0, 239.5]))) == 0.0
    assert not camera().late(seen).any()


def test_what_cannot_be_is_refused():
    with pytest.raises(CameraError, match="seconds"):
        camera().rolling(0.0, 20.0)
    with pytest.raises(CameraError, match="size"):
        dataclasses.replace(camera(), height=None).rolling(0.0, 0.02).late(jnp.zeros((3, 2)))
    run = follow_tracks(camera().rolling(0.0, READOUT), *clip(1)[:2], record=True)
    with pytest.raises(InputError, match="shutter rolls"):
        run.recording()
