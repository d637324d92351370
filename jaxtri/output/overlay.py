"""Augmented reality: a wire-frame car that stands in the scene (Yu et al. 2006, figures 8, 10 and 12)."""

from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxtri.errors import InputError
from jaxtri.geometry.camera import Camera

PIECES = 8  # of an edge where the lens bends it
BEYOND = 1.1  # of the border of the image: what lies just outside is drawn whole
NEAR = 0.02  # of the object's own distance, below which a point is behind the lens; a share, so units do not matter

DRAWS = 600  # of three points: even where a sixth of them lie on the plane, all draws miss it in 6 % of the scenes
BEHIND, PENALTY = 2.0, 3.0  # limits behind a plane from which a point counts against it, and how many on it it undoes
FACING, UPRIGHT = 3.0, 0.8  # how much more a plane counts whose normal is within 37 degrees of upwards
FIT_POINTS = 5  # among those of the plane nearest to the aim: their mean is where the object stands
GROUND = 0.5  # cosine to upwards from which a plane is one to stand on, not to hang on
LOWER = 0.75  # of the height of the image: well in front of what stands on a table
SLANTED = 1e-6  # cosine below which a ray runs along the plane
HEADING = np.deg2rad(25)  # from the image's x axis: what is seen from the side alone looks flat
CLIP = 3.0  # normalised: beyond, a lens model may fold back into the image

_to_pixels = jax.jit(Camera.to_pixels)
_to_normalised = jax.jit(Camera.to_normalised)


class Wireframe(NamedTuple):
    """Vertices and the pairs of them that are joined, in an object frame: x ahead, y left, z up, ground at z = 0."""

    vertices: Float[np.ndarray, "v 3"]
    edges: Int[np.ndarray, "e 2"]


class Plane(NamedTuple):
    """A plane through `point` with the unit `normal`, and the points that lie on it."""

    point: Float[np.ndarray, "3"]
    normal: Float[np.ndarray, "3"]
    inliers: Bool[np.ndarray, " n"]


def car() -> Wireframe:
    """A car of length 1: body, cabin and four wheels."""
    side = [
        (-0.50, 0.10),
        (-0.50, 0.24),
        (-0.42, 0.26),
        (-0.28, 0.41),
        (0.10, 0.41),
        (0.26, 0.26),
        (0.47, 0.22),
        (0.50, 0.10),
    ]
    half = 0.21
    vertices, edges = [], []
    for y in (-half, half):
        start = len(vertices)
        # The cabin leans inwards.
        vertices += [(x, y * (0.82 if z > 0.3 else 1.0), z) for x, z in side]
        edges += [(start + k, start + (k + 1) % len(side)) for k in range(len(side))]
    edges += [(k, k + len(side)) for k in range(len(side))]
    for y in (-half, half):  # window pillars and belt line
        start = len(vertices)
        vertices += [(-0.09, 0.82 * y, 0.41), (-0.07, y, 0.26), (-0.42, y, 0.26), (0.26, y, 0.26)]
        edges += [(start, start + 1), (start + 2, start + 3)]
    turn = np.linspace(0, 2 * np.pi, 13)[:-1]
    for x in (-0.30, 0.30):
        for y in (-half, half):
            start = len(vertices)
            vertices += [(x + 0.095 * np.cos(a), y, 0.095 + 0.095 * np.sin(a)) for a in turn]
            edges += [(start + k, start + (k + 1) % 12) for k in range(12)]
    return Wireframe(np.array(vertices), np.array(edges))


def draw_wireframe(
    image: UInt8[np.ndarray, "h w 3"],
    camera: Camera,
    T_camera_world: Float[np.ndarray, "4 4"],
    T_world_object: Float[np.ndarray, "4 4"],
    wireframe: Wireframe,
    *,
    colour: tuple[int, int, int] = (50, 70, 255),
    thickness: int = 2,
) -> UInt8[np.ndarray, "h w 3"]:
    """The image with the wire frame drawn into it, lens distortion included.

    `T_world_object` may hold a scale (a similarity). Edges are cut where they leave the view; long ones
    follow the distortion. `colour` is BGR.
    """
    T = T_camera_world @ T_world_object
    X = wireframe.vertices @ T[:3, :3].T + T[:3, 3]
    a, b, seen = _clip(X[wireframe.edges[:, 0]], X[wireframe.edges[:, 1]], _view_limits(camera, image.shape))
    pieces = np.linspace(0, 1, PIECES + 1 if camera.distortion is not None else 2)[:, None]
    line = a[:, None] + pieces * (b - a)[:, None]
    # All edges are projected, seen or not: another number of them would compile again.
    xy = line[..., :2] / np.where(seen[:, None, None], line[..., 2:], np.inf)
    pixels = np.asarray(_to_pixels(camera, jnp.asarray(xy, camera.fx.dtype)), np.float64)[seen]
    out = image.copy()
    fixed = np.round(pixels * 16).astype(np.int32)
    for shade, width in (((20, 20, 20), thickness + 2), (colour, thickness)):
        cv2.polylines(out, [*fixed], False, shade, width, cv2.LINE_AA, 4)
    return out


def _view_limits(camera: Camera, shape: tuple[int, ...]) -> np.ndarray:
    """Largest |x| and |y| in view, normalised, with a margin: beyond, a lens model may fold back into the image."""
    v, u = np.meshgrid([0, shape[0] / 2, shape[0]], [0, shape[1] / 2, shape[1]])
    border = _to_normalised(camera, jnp.asarray(np.stack([u, v], -1), camera.fx.dtype))
    return BEYOND * np.abs(np.asarray(border, np.float64)).max(axis=(0, 1))


def _clip(a: np.ndarray, b: np.ndarray, limits: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The parts of segments between points (e, 3) that are in view (|x| and |y| < limit z, z > near), and which are."""
    near = NEAR * max(float(np.median(np.linalg.norm(a, axis=1))), 1e-9)
    seen = np.ones(len(a), bool)
    x, y = limits
    for normal, least in (((0, 0, 1), near), ((1, 0, x), 0), ((-1, 0, x), 0), ((0, 1, y), 0), ((0, -1, y), 0)):
        da, db = (a @ normal - least)[:, None], (b @ normal - least)[:, None]
        seen &= ((da > 0) | (db > 0))[:, 0]
        step = (b - a) / np.where(da == db, 1, da - db)
        a, b = a + np.minimum(da, 0) * step, b + np.minimum(db, 0) * step
    return a, b, seen


def draw_text(image: UInt8[np.ndarray, "h w 3"], text: str) -> UInt8[np.ndarray, "h w 3"]:
    """The image with a line of text on a dark band at its lower left."""
    out = image.copy()
    font, size, h = cv2.FONT_HERSHEY_SIMPLEX, 0.5, image.shape[0]
    (width, height), below = cv2.getTextSize(text, font, size, 1)
    cv2.rectangle(out, (0, h - height - below - 10), (width + 20, h), (30, 30, 30), -1)
    cv2.putText(out, text, (10, h - below - 5), font, size, (255, 255, 255), 1, cv2.LINE_AA)
    return out


def dominant_plane(
    points: Float[np.ndarray, "n 3"],
    camera_centre: Float[np.ndarray, "3"],
    *,
    up: Float[np.ndarray, "3"] | None = None,
    share: float = 0.01,
    seed: int = 0,
) -> Plane:
    """The plane that most points lie on, by RANSAC; its normal points to the camera.

    A point lies on it within `share` of its distance from the camera. Nothing stands below a floor, nor
    behind a wall: points on the far side count against a plane. With `up` a plane that faces it counts three
    times, so that a table is preferred to the wall behind it. Raises `InputError` for fewer than three points.
    """
    if len(points) < 3:
        raise InputError(f"{len(points)} points: a plane needs three")
    rng = np.random.default_rng(seed)
    limit = share * np.linalg.norm(points - camera_centre, axis=1)
    best, most = None, -np.inf
    for _ in range(DRAWS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-12:
            continue
        normal *= np.sign(normal @ (camera_centre - a) or 1.0) / length
        height = (points - a) @ normal
        score = (np.abs(height) < limit).sum() - PENALTY * (height < -BEHIND * limit).sum()
        score *= FACING if score > 0 and up is not None and normal @ up > UPRIGHT else 1.0
        if score > most:
            best, most = np.abs(height) < limit, score
    if best is None:
        raise InputError("all points lie on one line: there is no plane among them")
    centre = points[best].mean(axis=0)
    normal = np.linalg.svd(points[best] - centre)[2][-1]
    if normal @ (camera_centre - centre) < 0:
        normal = -normal
    return Plane(centre, normal, np.abs((points - centre) @ normal) < limit)


def place(
    points: Float[np.ndarray, "n 3"],
    T_world_camera: Float[np.ndarray, "4 4"],
    camera: Camera,
    *,
    pixel: tuple[float, float] | None = None,
    size: float = 0.25,
) -> Float[np.ndarray, "4 4"]:
    """Where an object of length 1 stands: a similarity `T_world_object` on the dominant plane.

    Seen from the camera `T_world_camera` it stands at `pixel`, or among the plane's points near the middle of
    the image (lower, where the plane lies below the camera), and is `size` of the image wide; on a wall it
    stands out of it. Raises `InputError` where there is no plane, or the pixel does not meet it.
    """
    centre, R = T_world_camera[:3, 3], T_world_camera[:3, :3]
    seen = (points - centre) @ R
    ahead = seen[:, 2] > 0
    xy = seen[:, :2] / np.where(ahead, seen[:, 2], 1)[:, None]
    pixels = np.asarray(_to_pixels(camera, jnp.asarray(np.clip(xy, -CLIP, CLIP))))
    w, h = float(camera.width or 2 * camera.cx), float(camera.height or 2 * camera.cy)
    visible = ahead & (pixels > 0).all(axis=1) & (pixels < [w, h]).all(axis=1)
    plane = dominant_plane(points[visible], centre, up=-R[:, 1])
    if pixel is None:
        on = pixels[visible][plane.inliers]
        # In the middle of a wall or of the ground from above, but well in front of what stands on a table.
        aim = np.array([0.5 * w, (LOWER if plane.normal @ -R[:, 1] > GROUND else 0.5) * h])
        target = on[np.argsort(np.linalg.norm(on - aim, axis=1))[:FIT_POINTS]].mean(axis=0)
    else:
        target = np.array(pixel, float)
        if not ((target >= 0) & (target < [w, h])).all():
            raise InputError(f"--place {pixel[0]:g} {pixel[1]:g} lies outside the image of {w:g}x{h:g} pixels")
    ray = R @ np.append(np.asarray(camera.to_normalised(jnp.asarray(target))), 1.0)
    slope = ray @ plane.normal
    distance = (plane.point - centre) @ plane.normal / slope if abs(slope) > SLANTED else -1.0
    if distance <= 0:
        raise InputError("the dominant plane is not met at that pixel: choose another by --place")
    spot = centre + distance * ray
    # It heads along the image's x axis, as far as that lies in the plane.
    x = R[:, 0] - (R[:, 0] @ plane.normal) * plane.normal
    x /= np.linalg.norm(x)
    x = np.cos(HEADING) * x + np.sin(HEADING) * np.cross(plane.normal, x)
    scale = size * w / float(camera.fx * camera.magnification) * distance
    T = np.eye(4)
    T[:3, :3] = scale * np.stack([x, np.cross(plane.normal, x), plane.normal], axis=1)
    T[:3, 3] = spot
    return T
