"""Rendered clips with exact truth: the laboratory of `jaxtri demo` and a bare room, filmed in several ways."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3

from jaxtri.geometry.camera import Camera
from jaxtri.synthetic import textures
from jaxtri.synthetic.laboratory import laboratory
from jaxtri.synthetic.scene import Quad, Scene, box, quad, rendered_sequence, transform
from jaxtri.vision.video import Frame

TILT = np.radians(13)  # the rendered world is the first camera of the laboratory, so much downwards
FPS = 25.0
BARE, WEAK = ("bare_room", "bare_shake"), 2.5  # clips in a bare room, and grey levels of its texture


class Path(NamedTuple):
    """Rotation vectors (t, 3) in degrees, and positions (t, 3) in the laboratory: x right, y down, z to the wall."""

    turns: np.ndarray
    positions: np.ndarray
    noise_gray: float = 1.0


def camera() -> Camera:
    """Of all clips: 640x480 pixels."""
    return Camera.from_parameters(560, 560, 319.5, 239.5, width=640, height=480)


def _columns(*x: np.ndarray) -> np.ndarray:
    return np.stack(x, axis=1)


def _shake(n: int, rng: np.random.Generator) -> np.ndarray:
    """A random walk that comes back: a hand, (n, 3)."""
    walk = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    return walk - np.linspace(0, 1, n)[:, None] * walk[-1]


def calm(n: int, seed: int) -> dict[str, Path]:
    """Ways to film the laboratory."""
    rng, s, zero = np.random.default_rng(seed), np.linspace(0, 1, n), np.zeros(n)
    shake = _shake(n, rng)
    a = np.radians(50) * (s - 0.5)
    circle = _columns(0.08 + 1.1 * np.sin(a), zero - 0.05, 1.2 - 1.1 * np.cos(a))
    ahead = _columns(0.1 * s, zero, 0.9 * s - 0.5)
    slow = _columns(0.5 * s - 0.25, zero, 0.1 * s)
    fast = _columns(1.6 * s - 0.8, zero, zero + 0.3)
    hardly = _columns(0.12 * s, 0.02 * np.sin(6 * s), zero)
    return {
        "orbit": Path(_columns(zero + 10, -np.degrees(a), zero), circle),
        "forward": Path(_columns(zero + 6, 4 * np.sin(6 * s), zero), ahead),
        "hand_held": Path(0.25 * shake + [8, 0, 0], 0.005 * shake + slow),
        "short_tracks": Path(_columns(zero + 10, 12 * np.sin(9 * s), zero), fast, noise_gray=12.0),
        "near_rotation": Path(_columns(zero + 8, 25 * np.sin(5 * s), 3 * np.sin(8 * s)), hardly),
    }


def jerks(n: int, seed: int) -> dict[str, Path]:
    """Ways to film that break with a constant velocity; what happens, happens in the middle."""
    rng, s, zero = np.random.default_rng(seed + 1), np.linspace(0, 1, n), np.zeros(n)
    shake = _shake(n, rng)
    t, at = np.arange(n), n // 2
    walk = _columns(0.9 * s - 0.45, 0.01 * np.sin(40 * s), 0.1 * np.sin(5 * s))
    step = (t >= at).astype(float)
    pan = np.clip((t - at) / 8, 0, 1)  # 35 degrees in eight frames, from rest to rest
    stumble = np.exp(-(((t - at) / 2.0) ** 2))
    hand = 0.1 * shake
    # Frames of a hand that shakes: 1.5 degrees and two centimetres from one to the next, at random.
    jitter = rng.normal(size=(n, 3))
    return {
        # One frame is missing while the camera turns by 16 degrees and moves by 19 centimetres.
        "skipped": Path(hand + _columns(8 + zero, 16 * step - 8, zero), walk + step[:, None] * [0.19, 0, 0]),
        "stumble": Path(
            hand + _columns(8 + 6 * stumble, 2 * stumble, 4 * stumble), walk + stumble[:, None] * [0.03, 0.10, 0.03]
        ),
        "whip_pan": Path(hand + _columns(8 + zero, 35 * pan - 17, zero), walk),
        "shake": Path(hand + 1.5 * jitter + [8, 0, 0], walk + 0.02 * jitter[:, ::-1]),
        "bare_room": Path(0.4 * shake + [6, 0, 0], walk + 0.004 * shake, 6.0),
        "bare_shake": Path(hand + 1.5 * jitter + [6, 0, 0], walk + 0.02 * jitter[:, ::-1], 6.0),
    }


def truth(path: Path) -> np.ndarray:
    """Camera to world (t, 4, 4) in the rendered world."""

    room = _rotations(np.radians(path.turns * [-1, 1, 1]))
    room[:, :3, 3] = path.positions
    return _rotations(np.array([[TILT, 0, 0]])) @ room


def _rotations(vectors: np.ndarray) -> np.ndarray:
    """(t, 4, 4) of rotation vectors (t, 3), radians."""
    return np.array(jax.vmap(lambda w: SE3.exp(jnp.append(jnp.zeros(3), w)).as_matrix())(jnp.asarray(vectors)))


def bare_room(seed: int) -> Scene:
    """Walls, a floor and a few boxes of weak texture, in the world of the laboratory."""
    rng = np.random.default_rng(seed)

    def wall(corner: tuple, along: tuple, down: tuple) -> Quad:
        rows, columns = (int(160 * np.linalg.norm(v)) for v in (down, along))
        return quad(corner, along, down, textures.mottled(rows, columns, (190, 196, 198), rng, strength=WEAK))

    quads = [
        wall((-2.4, -1.3, 2.3), (4.8, 0, 0), (0, 2.3, 0)),
        wall((-2.4, -1.3, -1.5), (0, 0, 3.8), (0, 2.3, 0)),
        wall((2.4, -1.3, 2.3), (0, 0, -3.8), (0, 2.3, 0)),
        wall((-2.4, 1.0, 2.3), (4.8, 0, 0), (0, 0, -3.8)),
    ]
    for x, z, side in ((-0.7, 1.3, 0.5), (0.5, 1.6, 0.7), (1.3, 1.1, 0.4), (-1.5, 1.8, 0.6), (0.0, 1.1, 0.3)):
        tone = tuple(rng.uniform(110, 200, 3))
        faces = [textures.mottled(60, 60, tone, rng, strength=WEAK) for _ in range(6)]
        quads += box((x, 1.0 - side / 2, z), (side, side, side), rng.uniform(-0.5, 0.5), faces)
    return transform(Scene(tuple(quads), (90, 95, 98)), _rotations(np.array([[TILT, 0, 0]]))[0])


def rendered(
    name: str, path: Path, seed: int, lens: Camera | None = None, zoom: np.ndarray | None = None
) -> Iterator[Frame]:
    """The frames along a path; by another camera, or one whose focal length is so many times its own in each frame."""
    scene, poses = bare_room(seed) if name in BARE else laboratory(1, seed).scene, truth(path)
    seen_by, noise = lens or camera(), {"noise_gray": path.noise_gray, "seed": seed}
    if zoom is None:
        images = rendered_sequence(scene, seen_by, poses, **noise)
    else:
        cameras = (replace(seen_by, fx=seen_by.fx * z, fy=seen_by.fy * z) for z in zoom)
        noises = ({**noise, "seed": seed + 1000 * k} for k in range(len(poses)))
        images = (
            next(rendered_sequence(scene, c, T[None], **n)) for c, T, n in zip(cameras, poses, noises, strict=True)
        )
    for k, image in enumerate(images):
        yield Frame(k, k / FPS, image)
