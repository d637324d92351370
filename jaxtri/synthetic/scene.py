"""A small renderer of textured rectangles with exact truth, in NumPy: rays, a depth buffer, area sampling."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from jaxtri.errors import InputError
from jaxtri.geometry.camera import Camera

_NEAR = 1e-3  # depth in the camera, in units of the scene, below which nothing is drawn: what is behind stays finite
_EDGE_ON = 1e-12  # volume of corner and edges over the edges' lengths, below which a rectangle shows no face
_FOOTPRINT = 1.2  # width in pixels over which a texture is averaged: a little more than one, against aliasing
_CHUNK = 1 << 14  # samples shaded together, so that the temporaries stay in the cache


@dataclass(frozen=True)
class Quad:
    """A textured parallelogram: world point `corner` + u `edge_u` + v `edge_v`, with u and v in [0, 1].

    It is seen only from the side from which the texture is not mirrored.

    Attributes:
        corner: (3,) its first corner in the world, units of the scene.
        edge_u: (3,) its edge along the columns of the texture.
        edge_v: (3,) its edge along the rows of the texture.
        texture: (rows, columns, 3) uint8, BGR.
        integral: (rows + 1, columns + 1, 3) sums of the texture over all texels above and to the left.
    """

    corner: Float[np.ndarray, "3"]
    edge_u: Float[np.ndarray, "3"]
    edge_v: Float[np.ndarray, "3"]
    texture: UInt8[np.ndarray, "rows columns 3"]
    integral: Float[np.ndarray, "rows1 columns1 3"]


@dataclass(frozen=True)
class Scene:
    """Rectangles before a background of one colour.

    Attributes:
        quads: The rectangles.
        background: Blue, green, red, 0 to 255; a middle gray by default, against which dark and light both stand out.
    """

    quads: tuple[Quad, ...]
    background: tuple[int, int, int] = (96, 96, 96)


class Rendering(NamedTuple):
    """What the camera sees.

    Attributes:
        image: (h, w, 3) uint8, BGR.
        depth: (h, w) z of the surface in the camera's frame at every pixel centre, units of the scene; inf where there
            is none.
    """

    image: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]


def quad(
    corner: Sequence[float] | np.ndarray,
    edge_u: Sequence[float] | np.ndarray,
    edge_v: Sequence[float] | np.ndarray,
    texture: UInt8[np.ndarray, "rows columns 3"],
) -> Quad:
    """A textured parallelogram from its first corner and two edges, in world coordinates."""
    rows, columns = texture.shape[:2]
    integral = np.zeros((rows + 1, columns + 1, 3))
    integral[1:, 1:] = texture.astype(np.float64).cumsum(0).cumsum(1)
    corner, edge_u, edge_v = (np.asarray(v, np.float64) for v in (corner, edge_u, edge_v))
    return Quad(corner, edge_u, edge_v, texture, integral)


def box(
    centre: Sequence[float] | np.ndarray,
    size: Sequence[float] | np.ndarray,
    yaw: float,
    faces: Sequence[UInt8[np.ndarray, "_ _ 3"]],
) -> list[Quad]:
    """The six faces of a box turned by `yaw` radians about the y axis, textures upright as seen from outside.

    `size` is (x, y, z); `faces` are the textures of front (-z), right (+x), back (+z), left (-x), top (-y) and
    bottom (+y).
    """
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = np.diag(np.asarray(size, np.float64)) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    centre = np.asarray(centre, np.float64)
    # (outward normal, direction of the columns, direction of the rows)
    sides = [(-z, x, y), (x, z, y), (z, -x, y), (-x, -z, y), (-y, x, -z), (y, x, z)]
    return [quad(centre + (n - u - v) / 2, u, v, face) for (n, u, v), face in zip(sides, faces, strict=True)]


def transform(scene: Scene, T_new_world: Float[np.ndarray, "4 4"]) -> Scene:
    """The same scene in other world coordinates."""
    R, t = T_new_world[:3, :3], T_new_world[:3, 3]
    moved = (Quad(R @ q.corner + t, R @ q.edge_u, R @ q.edge_v, q.texture, q.integral) for q in scene.quads)
    return Scene(tuple(moved), scene.background)


def pixel_rays(camera: Camera) -> Float[np.ndarray, "h w 2"]:
    """Normalised, undistorted coordinates of every pixel centre. Raises InputError for a camera without size."""
    if camera.width is None or camera.height is None:
        raise InputError("the camera has no image size; give it a width and a height")
    v, u = np.mgrid[: camera.height, : camera.width]
    pixels = jnp.asarray(np.stack([u, v], -1), camera.fx.dtype)
    return np.asarray(camera.to_normalised(pixels), np.float64)


def render(
    scene: Scene,
    camera: Camera,
    T_camera_world: Float[np.ndarray | jax.Array, "4 4"],
    *,
    supersample: int = 4,
    rays: Float[np.ndarray, "h w 2"] | None = None,
) -> Rendering:
    """The scene as the camera sees it.

    Textures are averaged over the footprint of each pixel, which is free of aliasing and of shifts; pixels at
    the outlines of rectangles are the mean of `supersample` squared rays. `rays` are those of `pixel_rays`,
    to be computed once for a sequence. Footprints neglect how the lens changes the size of a pixel.
    """
    x, y = np.moveaxis(pixel_rays(camera) if rays is None else rays, -1, 0)
    T = np.asarray(T_camera_world, np.float64)
    faces = [face for q in scene.quads if (face := _Face.seen(q, T)) is not None]
    pixel = (1 / float(camera.fx * camera.magnification), 1 / float(camera.fy * camera.magnification))
    owner, inverse_depth = _trace(faces, x, y)
    colours = _shade(faces, scene.background, owner, x, y, pixel)

    edge = np.zeros(owner.shape, bool)
    for here, there in ((np.s_[1:, :], np.s_[:-1, :]), (np.s_[:, 1:], np.s_[:, :-1])):
        differs = owner[here] != owner[there]
        edge[here] |= differs
        edge[there] |= differs
    if edge.any():
        (xv, xu), (yv, yu) = np.gradient(x), np.gradient(y)
        offsets = (np.arange(supersample) + 0.5) / supersample - 0.5
        dv, du = (o.reshape(-1, 1) for o in np.meshgrid(offsets, offsets))
        xs, ys = x[edge] + du * xu[edge] + dv * xv[edge], y[edge] + du * yu[edge] + dv * yv[edge]
        colours[edge] = _shade(faces, scene.background, _trace(faces, xs, ys)[0], xs, ys, pixel).mean(0)
    with np.errstate(divide="ignore"):
        depth = 1 / inverse_depth
    return Rendering((colours + 0.5).clip(0, 255).astype(np.uint8), depth)


def rendered_sequence(
    scene: Scene,
    camera: Camera,
    T_world_camera: Float[np.ndarray | jax.Array, "t 4 4"],
    *,
    noise_gray: float = 0.0,
    seed: int = 0,
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """The images (BGR) along a trajectory, with Gaussian noise of the given standard deviation in gray levels.

    They are rendered ahead by two threads, since nearly all of the work is NumPy's.
    """
    rays = pixel_rays(camera)

    def frame(k: int, T: np.ndarray) -> np.ndarray:
        image = render(scene, camera, np.linalg.solve(T, np.eye(4)), supersample=3, rays=rays).image
        if noise_gray == 0:
            return image
        noise = np.random.default_rng((seed, k)).standard_normal(image.shape, np.float32)
        return (image + noise_gray * noise + 0.5).clip(0, 255).astype(np.uint8)

    poses = np.asarray(T_world_camera, np.float64)
    with ThreadPoolExecutor(2) as pool:
        for k in range(0, len(poses), 16):  # a few at a time: a long sequence need not fit into memory
            yield from pool.map(frame, range(k, len(poses)), poses[k : k + 16])


class _Face(NamedTuple):
    """A quad before a camera: M @ (x, y, 1) = (u, v, 1) / z for the ray through the normalised point (x, y)."""

    quad: Quad
    M: np.ndarray
    bounds: tuple[np.ndarray, np.ndarray] | None

    @classmethod
    def seen(cls, q: Quad, T: np.ndarray) -> "_Face | None":
        c, a, b = T[:3, :3] @ q.corner + T[:3, 3], T[:3, :3] @ q.edge_u, T[:3, :3] @ q.edge_v
        volume = np.cross(a, b) @ c
        corners = np.array([c, c + a, c + b, c + a + b])
        if volume <= _EDGE_ON * np.linalg.norm(a) * np.linalg.norm(b) or (corners[:, 2] < _NEAR).all():
            return None  # from behind or edge-on, or behind the camera
        M = np.array([np.cross(b, c), np.cross(c, a), np.cross(a, b)]) / volume
        if (corners[:, 2] < _NEAR).any():
            return cls(q, M, None)
        xy = corners[:, :2] / corners[:, 2:]
        return cls(q, M, (xy.min(0), xy.max(0)))


def _trace(faces: list[_Face], x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number of the nearest face and its inverse depth for each ray of a 2-d array; -1 and 0 for none."""
    owner, nearest = np.full(x.shape, -1, np.int16), np.zeros(x.shape)
    extents = [[(v.min(axis), v.max(axis)) for v in (x, y)] for axis in (1, 0)]
    for number, face in enumerate(faces):
        window = [slice(None), slice(None)]
        if face.bounds is not None:
            for axis in (0, 1):
                inside = np.ones(x.shape[axis], bool)
                for (low, high), least, most in zip(extents[axis], *face.bounds, strict=True):
                    inside &= (low <= most) & (high >= least)
                hit = np.flatnonzero(inside)
                window[axis] = slice(hit[0], hit[-1] + 1) if hit.size else slice(0, 0)
        here = tuple(window)
        xs, ys = x[here], y[here]
        hu, hv, hw = (m[0] * xs + m[1] * ys + m[2] for m in face.M)
        wins = (hw > nearest[here]) & (hw < 1 / _NEAR) & (hu >= 0) & (hu <= hw) & (hv >= 0) & (hv <= hw)
        owner[here][wins] = number
        nearest[here][wins] = hw[wins]
    return owner, nearest


def _shade(
    faces: list[_Face],
    background: tuple[int, int, int],
    owner: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    pixel: tuple[float, float],
) -> np.ndarray:
    """Colours of traced rays; each is the mean of the texture over the footprint of a pixel."""
    colours = np.empty((owner.size, 3))
    colours[:] = background
    flat, x, y = owner.ravel(), x.ravel(), y.ravel()
    order = np.argsort(flat, kind="stable")
    starts = np.searchsorted(flat[order], np.arange(len(faces) + 1))
    for face, start, stop in zip(faces, starts[:-1], starts[1:], strict=True):
        table = face.quad.integral
        size = (table.shape[1] - 1, table.shape[0] - 1)
        for k in range(start, stop, _CHUNK):
            chosen = order[k : min(k + _CHUNK, stop)]
            xs, ys = x[chosen], y[chosen]
            hu, hv, hw = (m[0] * xs + m[1] * ys + m[2] for m in face.M)
            spans = []
            for h, m, texels in ((hu, face.M[0], size[0]), (hv, face.M[1], size[1])):
                at = h / hw
                slope = sum(abs(m[i] - at * face.M[2, i]) * pixel[i] for i in (0, 1)) / hw
                # At least one texel: a box of one over constant texels is linear interpolation.
                half = 0.5 * np.maximum(_FOOTPRINT * texels * slope, 1)
                spans.append(((at * texels - half).clip(0, texels), (at * texels + half).clip(0, texels)))
            (u0, u1), (v0, v1) = spans
            total = _integral(table, u1, v1) - _integral(table, u0, v1)
            total -= _integral(table, u1, v0) - _integral(table, u0, v0)
            colours[chosen] = total / ((u1 - u0) * (v1 - v0))[:, None]
    return colours.reshape(*owner.shape, 3)


def _integral(table: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The integral of the texture over [0, u] x [0, v], which is exactly bilinear in between texels."""
    rows, columns = table.shape[:2]
    i, j = np.minimum(v.astype(np.int64), rows - 2), np.minimum(u.astype(np.int64), columns - 2)
    fv, fu = v - i, u - j
    flat, at = table.reshape(-1, 3), i * columns + j
    total = np.zeros((len(u), 3))
    # `take` gathers rows four times faster than an index does.
    for shift, weight in (
        (0, (1 - fv) * (1 - fu)),
        (1, (1 - fv) * fu),
        (columns, fv * (1 - fu)),
        (columns + 1, fv * fu),
    ):
        total += weight[:, None] * flat.take(at + shift, axis=0)
    return total
