"""Scenes to film: a laboratory table after the paper's first sequence, a plane, and nothing at all."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxtri.geometry.camera import Camera
from jaxtri.synthetic import textures
from jaxtri.synthetic.scene import Quad, Scene, box, quad, transform

YELLOW = (40, 200, 245)


class Footage(NamedTuple):
    """A scene and how it is filmed.

    Attributes:
        scene: What is filmed.
        camera: The camera, with the size of its images.
        times: (t,) seconds.
        T_world_camera: (t, 4, 4) float64, the true poses, camera to world, metres.
    """

    scene: Scene
    camera: Camera
    times: Float[np.ndarray, " t"]
    T_world_camera: Float[np.ndarray, "t 4 4"]


def laboratory(n_frames: int = 100, seed: int = 0) -> Footage:
    """A rig that slides sideways before boxes on a table: 640x480 pixels, 25 frames a second, 5 mm a frame.

    One box is yellow and has room before it. The rig vibrates by tenths of a millimetre and turns by less
    than a degree. World: the camera of frame 0. After Yu et al. 2006, section VIII.B, figures 8 and 9.
    """
    rng = np.random.default_rng(seed)
    camera = Camera.from_parameters(560, 560, 319.5, 239.5, width=640, height=480)
    times = np.arange(n_frames) / 25
    tilt = np.radians(13)  # downwards, in the room's frame: x right, y down, z to the wall
    room = np.tile(np.eye(4), (n_frames, 1, 1))
    amplitude, phase = np.radians([0.3, 0.4, 0.25]), rng.uniform(0, 2 * np.pi, (2, 3))
    angles = amplitude * (np.sin(2 * np.pi * times[:, None] / [5, 7, 3.6] + phase[0]) - np.sin(phase[0]))
    shake = np.sin(2 * np.pi * times[:, None] * [6.1, 8.3, 7.2] + phase[1])
    angles += np.radians(0.02) * shake[:, ::-1] + rng.normal(scale=np.radians(0.005), size=(n_frames, 3))
    room[:, :3, :3] = _rotations(np.array([[-tilt, 0, 0]])) @ _rotations(angles)
    room[:, :3, 3] = 0.0004 * shake
    room[:, 0, 3] += 0.005 * 25 * times
    room[:, :3, 3] += rng.normal(scale=0.0001, size=(n_frames, 3))
    T_camera0_room = np.linalg.solve(room[0], np.eye(4))
    return Footage(transform(_room(rng), T_camera0_room), camera, times, T_camera0_room @ room)


def planar_scene(seed: int = 0, *, depth: float = 2.0) -> Scene:
    """One large wall of coloured patches across the z axis at `depth`: degenerate for the eight-point method."""
    texture = textures.patches(900, 1200, np.random.default_rng(seed))
    w, h = 1.6 * depth, 1.2 * depth
    return Scene((quad((-w / 2, -h / 2, depth), (w, 0, 0), (0, h, 0), texture),))


def blank_scene(*, depth: float = 2.0) -> Scene:
    """A wall without any texture, which fills the view: nothing to track."""
    size = 20 * depth
    edges = ((size, 0, 0), (0, size, 0))
    return Scene((quad((-size / 2, -size / 2, depth), *edges, textures.plain(2, 2, (150, 150, 150))),))


def _rotations(vectors: np.ndarray) -> np.ndarray:
    """Matrices of rotation vectors, in float64 whatever JAX computes in: the truth is to be exact."""
    from scipy.spatial.transform import Rotation  # loaded when it is needed: it takes time

    return Rotation.from_rotvec(vectors).as_matrix()


# Goods on the table: centre (x, z), size (x, y, z), yaw in degrees, colour.
_GOODS = [
    ((0.08, 1.12), (0.30, 0.20, 0.16), 14, YELLOW),
    ((-0.38, 1.28), (0.20, 0.34, 0.15), -20, (150, 90, 40)),
    ((-0.62, 0.98), (0.17, 0.12, 0.13), 32, (60, 60, 190)),
    ((0.55, 1.32), (0.24, 0.26, 0.18), -12, (110, 150, 180)),
    ((0.72, 1.00), (0.13, 0.17, 0.12), 28, (90, 150, 70)),
    ((1.02, 1.22), (0.26, 0.15, 0.20), 8, (170, 170, 165)),
    ((-0.95, 1.36), (0.22, 0.20, 0.18), 10, (120, 70, 130)),
]
_TABLE_Y, _WALL_Z = 0.42, 2.3


def _room(rng: np.random.Generator) -> Scene:
    """The laboratory in its own frame: x right, y down, z to the wall, metres."""
    wall = textures.mottled(560, 1100, (196, 202, 204), rng, strength=2.5)
    quads = [quad((-2.4, -1.3, _WALL_Z), (5.2, 0, 0), (0, 2.65, 0), wall)]
    for x, y, w, h in (
        (-1.22, -0.33, 0.50, 0.62),
        (-0.44, -0.36, 0.72, 0.50),
        (0.52, -0.34, 0.50, 0.62),
        (1.24, -0.36, 0.72, 0.50),
    ):
        texture = textures.poster(int(560 * h), int(560 * w), rng)
        quads.append(quad((x, y, _WALL_Z - 0.01), (w, 0, 0), (0, h, 0), texture))
    quads += _table(rng)
    light = (0.93, 0.78, 0.7, 0.86, 1.08, 0.5)  # of front, right, back, left, top, bottom
    for (x, z), size, yaw, colour in _GOODS:
        w, h, d = (int(900 * length) for length in size)
        shapes = ((h, w), (h, d), (h, w), (h, d), (d, w), (d, w))
        faces = [textures.shade(textures.printed(*s, colour, rng), f) for s, f in zip(shapes, light, strict=True)]
        quads += box((x, _TABLE_Y - size[1] / 2, z), size, np.radians(yaw), faces)
    books = [textures.spines(270, 950, rng), *[textures.plain(2, 2, (150, 165, 170))] * 5]
    quads += box((0.1, _TABLE_Y - 0.12, 1.54), (0.85, 0.24, 0.16), 0.0, books)
    return Scene(tuple(quads), (90, 95, 98))


def _table(rng: np.random.Generator) -> list[Quad]:
    left, near, width, deep = -1.5, 0.45, 3.4, 1.2
    top = textures.wood(480, 1100, rng)
    # Soft shadows where the goods stand: rows of the texture run towards the viewer.
    z, x = np.meshgrid(near + deep * (1 - np.arange(480) / 480), left + width * np.arange(1100) / 1100, indexing="ij")
    shadow = np.ones(x.shape)
    for (cx, cz), size, yaw, _ in _GOODS:
        c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
        along, across = c * (x - cx) - s * (z - cz), s * (x - cx) + c * (z - cz)
        outside = np.hypot(*(np.maximum(abs(v) - w / 2, 0) for v, w in ((along, size[0]), (across, size[2]))))
        shadow *= 1 - 0.5 * np.exp(-outside / 0.035)
    far = (left, _TABLE_Y, near + deep)
    quads = [
        quad(far, (width, 0, 0), (0, 0, -deep), textures.shade(top, shadow)),
    ]
    for x0, z0, w, d, turn, make in (
        (-0.28, 0.78, 0.21, 0.29, 12, textures.page),
        (0.62, 0.74, 0.21, 0.29, -18, textures.page),
        (-0.75, 0.72, 0.26, 0.20, -8, textures.poster),
        (0.28, 0.72, 0.20, 0.15, 24, _board),
        (0.95, 0.80, 0.26, 0.20, 15, textures.poster),
    ):
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        u, v = np.array([c, 0, s]) * w, np.array([s, 0, -c]) * d
        middle = np.array([x0, _TABLE_Y - 0.002, z0])
        quads.append(quad(middle - (u + v) / 2, u, v, make(int(1200 * d), int(1200 * w), rng)))
    return quads


def _board(rows: int, columns: int, rng: np.random.Generator) -> np.ndarray:
    return textures.checks(rows, columns, (6, 8), ((225, 225, 225), (40, 40, 40)))
