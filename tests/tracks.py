"""Feature tracks of a made-up scene with exact truth: what the tests of the tracker are fed with."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtri.geometry.camera import Camera

CAPACITY = 128  # the same everywhere, so that a test file compiles the tracker once


class Tracks(NamedTuple):
    """Tracks in slots, and the true camera centres and rotations (world to camera)."""

    camera: Camera
    pixels: np.ndarray  # (t, n, 2)
    visible: np.ndarray  # (t, n)
    R: np.ndarray  # (t, 3, 3)
    centres: np.ndarray  # (t, 3)
    points: np.ndarray  # (n, 3) in the world

    @property
    def T_world_camera(self) -> np.ndarray:
        T = np.tile(np.eye(4), (len(self.R), 1, 1))
        T[:, :3, :3] = self.R.transpose(0, 2, 1)
        T[:, :3, 3] = self.centres
        return T


def camera() -> Camera:
    return Camera.from_parameters(500, 500, 320, 240, width=640, height=480)


def rotation(axis_angle: np.ndarray) -> np.ndarray:
    """Rodrigues' formula."""
    angle = np.linalg.norm(axis_angle)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = axis_angle / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def make(
    centres: np.ndarray,
    turns: np.ndarray,
    *,
    noise_px: float = 0.3,
    plane: bool = False,
    seed: int = 0,
    depth: float = 4.0,
) -> Tracks:
    """Tracks of points around `depth` seen from cameras at `centres` (t, 3), turned by the vectors `turns` (t, 3)."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2.2, -1.6, depth - 1.2], [2.2, 1.6, depth + 1.2], (CAPACITY, 3))
    if plane:
        points[:, 2] = depth + 0.25 * points[:, 0]
    R = np.stack([rotation(-t) for t in turns])
    X = np.einsum("tij,tnj->tni", R, points[None] - centres[:, None])
    cam = camera()
    pixels = np.array(jax.jit(Camera.to_pixels)(cam, jnp.asarray(X[..., :2] / X[..., 2:])))
    pixels += rng.normal(scale=noise_px, size=pixels.shape)
    visible = (X[..., 2] > 0.1) & (pixels > 0).all(-1) & (pixels < [640, 480]).all(-1)
    # A track that has left does not come back.
    visible = np.logical_and.accumulate(visible, axis=0) if visible[0].any() else visible
    return Tracks(cam, pixels, visible, R, centres, points)


def sideways(n: int = 30, **options) -> Tracks:
    """A camera that slides to the right while it turns a little."""
    t = np.arange(n)[:, None]
    return make(t * [0.03, 0.002, 0.004], np.sin(t / 9) * [0.01, 0.03, 0.02], **options)
