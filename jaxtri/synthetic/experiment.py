"""The paper's synthetic experiment, from a key. Source: Yu et al. 2006, section VIII.A.

What the paper leaves open is stated here: the pixel pitch (10 micrometres: 600 px of focal length), the
signs of the motion (drawn per axis and segment; along z the object recedes, so that no point passes the
camera), its centre of rotation (the centre of the object), and the scale gauge (metres; the length of the
first base line may be given instead). All but the centre may be changed.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SO3
from jaxtyping import Array, Float, PRNGKeyArray


class Experiment(NamedTuple):
    """One synthetic sequence: noisy points, and the truth.

    Attributes:
        points: (n, 3) in the camera of frame 0, which is the world, metres.
        rotations: (t, 3, 3) world to camera.
        translations: (t, 3) T of X_camera = R X_world + T, metres.
        clean: (t, n, 2) normalised image points without noise.
        observed: (t, n, 2) the same with noise.
        sigma: Standard deviation of an image point in normalised image units: noise_px / focal length.
    """

    points: Float[Array, "n 3"]
    rotations: Float[Array, "t 3 3"]
    translations: Float[Array, "t 3"]
    clean: Float[Array, "t n 2"]
    observed: Float[Array, "t n 2"]
    sigma: Float[Array, ""]


def paper_experiment(
    key: PRNGKeyArray,
    *,
    n_points: int = 300,
    n_frames: int = 99,
    volume_m3: float = 0.13,
    distance_m: float = 0.33,
    degrees_per_frame: tuple[float, float] = (0.2, 1.2),
    metres_per_frame: tuple[float, float] = (0.005, 0.015),
    noise_px: Float[Array, ""] | float = 0.1,
    focal_mm: float = 6.0,
    pixel_mm: float = 0.01,
    signs: Float[Array, "3 6"] | None = None,
    base_line: float | None = None,
    phases: Sequence[int] = (0, 1, 2),
) -> Experiment:
    """One trial: pure translation, pure rotation, then both, each a third of the frames; vmap over keys.

    `phases` are the ones of the three that are run, in equal parts: (2,) is the general motion alone. `signs` (+-1) are
    the signs of the motion, a row per phase, columns (tx, ty, tz, rx, ry, rz); drawn by default, tz positive. With
    `base_line` the scene and its motion are scaled so that the camera's first step has this length. `noise_px` is the
    standard deviation of an image point in pixels, at a focal length of `focal_mm` over `pixel_mm` pixels.
    """
    k_points, k_turn, k_shift, k_sign, k_noise = jax.random.split(key, 5)
    side = volume_m3 ** (1 / 3)
    centre = jnp.array([0.0, 0.0, distance_m])
    points = centre + jax.random.uniform(k_points, (n_points, 3), minval=-side / 2, maxval=side / 2)

    part = jnp.minimum(jnp.arange(n_frames - 1) * len(phases) // (n_frames - 1), len(phases) - 1)
    segment = jnp.array(phases)[part]
    if signs is None:
        signs = jnp.where(jax.random.bernoulli(k_sign, shape=(3, 6)), 1.0, -1.0).at[:, 2].set(1.0)
    low, high = metres_per_frame
    shift = jax.random.uniform(k_shift, (n_frames - 1, 3), minval=low, maxval=high) * signs[segment, :3]
    low, high = (jnp.deg2rad(d) for d in degrees_per_frame)
    turn = jax.random.uniform(k_turn, (n_frames - 1, 3), minval=low, maxval=high) * signs[segment, 3:]
    shift = jnp.where(segment[:, None] == 1, 0.0, shift)
    turn = jnp.where(segment[:, None] == 0, 0.0, turn)

    rotations, translations = _poses(turn, shift, centre)
    e = _observed(k_noise, points, rotations, translations, jnp.asarray(noise_px * pixel_mm / focal_mm))
    if base_line is not None:
        scale = base_line / jnp.linalg.norm(e.translations[1])
        e = e._replace(points=scale * e.points, translations=scale * e.translations)
    return e


def steady_experiment(
    key: PRNGKeyArray,
    *,
    metres_per_frame: tuple[float, float, float] = (0.0, 0.0, 0.0),
    degrees_per_frame: tuple[float, float, float] = (0.0, 0.0, 0.0),
    orbit: bool = False,
    n_points: int = 300,
    n_frames: int = 99,
    side_m: float = 0.5,
    distance_m: float = 1.0,
    jitter_m: float = 1e-3,
    jitter_degrees: float = 0.1,
    noise_px: Float[Array, ""] | float = 0.1,
    focal_px: float = 600.0,
) -> Experiment:
    """A cube of points before a camera that moves steadily, but for white jitter, in its own axes.

    The velocities are those of the points in the camera: (0, 0, .01) recedes from the cube by a centimetre a
    frame. With `orbit` the rotation is about the centre of the cube. `noise_px` is the standard deviation of an image
    point in pixels, at a focal length of `focal_px`.
    """
    k_points, k_turn, k_shift, k_noise = jax.random.split(key, 4)
    centre = jnp.array([0.0, 0.0, distance_m])
    points = centre + jax.random.uniform(k_points, (n_points, 3), minval=-side_m / 2, maxval=side_m / 2)
    turn = jitter_degrees * jax.random.normal(k_turn, (n_frames - 1, 3)) + jnp.array(degrees_per_frame)
    shift = jitter_m * jax.random.normal(k_shift, (n_frames - 1, 3)) + jnp.array(metres_per_frame)
    rotations, translations = _poses(jnp.deg2rad(turn), shift, centre if orbit else None)
    return _observed(k_noise, points, rotations, translations, jnp.asarray(noise_px / focal_px))


def _poses(
    turns: Float[Array, "m 3"], shifts: Float[Array, "m 3"], centre: Float[Array, "3"] | None
) -> tuple[Float[Array, "m 3 3"], Float[Array, "m 3"]]:
    """Poses (R, T), world to camera, of all frames but the first: after each turn (radians) and shift of the world.

    The world is turned about `centre`, one of its points, or about the camera where there is none.
    """

    def move(carry: tuple[SO3, Array], rates: tuple[Array, Array]) -> tuple[tuple[SO3, Array], tuple[Array, Array]]:
        rotation, T = carry
        turn = SO3.exp(rates[0])
        about = jnp.zeros(3) if centre is None else rotation @ centre + T
        rotation, T = (turn @ rotation).normalize(), turn @ (T - about) + about + rates[1]
        return (rotation, T), (rotation.as_matrix(), T)

    return jax.lax.scan(move, (SO3.identity(), jnp.zeros(3)), (turns, shifts))[1]


def _observed(key: PRNGKeyArray, points: Array, rotations: Array, translations: Array, sigma: Array) -> Experiment:
    """The experiment: what is seen of the points, with noise. The poses are those of all frames but the first."""
    rotations = jnp.concatenate([jnp.eye(3)[None], rotations])
    translations = jnp.concatenate([jnp.zeros((1, 3)), translations])
    camera = jnp.einsum("tij,nj->tni", rotations, points) + translations[:, None]
    clean = camera[..., :2] / camera[..., 2:]
    observed = clean + sigma * jax.random.normal(key, clean.shape)
    return Experiment(points, rotations, translations, clean, observed, sigma)
