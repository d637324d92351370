"""Rendered situations of real footage with exact truth: traffic, people, cuts, a hand before the lens, two rounds.

World: x right, y down, z ahead, metres; the camera is 1.5 m above the ground. 25 frames a second, noise of one grey
level. Frames are rendered as they are asked for.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from jaxtri.geometry.camera import Camera
from jaxtri.synthetic import textures
from jaxtri.synthetic.scene import Quad, Scene, box, pixel_rays, quad, render, transform

FPS = 25.0
EYE = 1.5  # height of the camera
SKIN = (120, 150, 205)
AWAY = np.eye(4)  # where another room is
AWAY[0, 3] = 50.0
Images = Iterator[np.ndarray]


class Situation(NamedTuple):
    """What is filmed, and what should be said of it.

    Attributes:
        camera: The true one.
        images: The frames, BGR, once.
        T_world_camera: (t, 4, 4) true poses; those of another room are in a world of its own.
        expected: What should be said, in words.
        cuts: First and last frame of each change of shot: of a hard cut the first frame of the new shot, of a dissolve
            those that show both.
        shown: The frame that shows best what it is about.
    """

    camera: Camera
    images: Images
    T_world_camera: np.ndarray
    expected: str
    cuts: tuple[tuple[int, int], ...] = ()
    shown: int = 0


def pinhole(f: float = 280.0) -> Camera:
    """320x240 pixels."""
    return Camera.from_parameters(f, f, 159.5, 119.5, width=320, height=240)


def poses(positions: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Camera to world (t, 4, 4): positions (t, 3), and yaw to the right, pitch upwards and roll (t, 3), degrees."""
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("YXZ", turns, degrees=True).as_matrix()
    T[:, :3, 3] = positions
    return T


def tremor(seconds: np.ndarray, seed: int, degrees: float = 0.25) -> tuple[np.ndarray, np.ndarray]:
    """A hand: positions (t, 3), and turns in degrees, of smooth shaking at 0.7 to 5 hertz."""
    rng = np.random.default_rng((seed, 1))
    hertz, phase, size = (
        rng.uniform(0.7, 5, (2, 4, 3)),
        rng.uniform(0, 2 * np.pi, (2, 4, 3)),
        np.array([0.003, degrees]),
    )
    waves = np.sin(2 * np.pi * hertz[:, None] * np.asarray(seconds)[:, None, None] + phase[:, None]).mean(axis=2)
    return 2 * size[0] * waves[0], 2 * size[1] * waves[1]


def by_hand(positions: np.ndarray, turns: np.ndarray, seed: int) -> np.ndarray:
    """Poses along a path, shaken."""
    shift, turn = tremor(np.arange(len(positions)) / FPS, seed)
    return poses(positions + shift, turns + turn)


def film(
    scene: Scene | Callable[[int], Scene],
    camera: Camera,
    T: np.ndarray,
    seed: int,
    put: Callable[[int, np.ndarray], np.ndarray] = lambda _, image: image,
) -> Images:
    """The frames along poses (t, 4, 4); with (t, b, 4, 4) of as many bands of rows, each exposed at its own pose.

    `scene` may change from frame to frame; `put` changes the picture before its noise is added.
    """
    rays = pixel_rays(camera)
    bands = np.array_split(np.arange(len(rays)), T.shape[1] if T.ndim == 4 else 1)
    for k, pose in enumerate(T.reshape(len(T), len(bands), 4, 4)):
        now = scene if isinstance(scene, Scene) else scene(k)
        parts = zip(bands, np.linalg.inv(pose), strict=True)
        image = np.concatenate([render(now, camera, P, supersample=2, rays=rays[rows]).image for rows, P in parts])
        noise = np.random.default_rng((seed, k)).standard_normal(image.shape, np.float32)
        yield (put(k, image) + noise + 0.5).clip(0, 255).astype(np.uint8)


# ---------------------------------------------------------------- a room


def _wall(corner: tuple, along: tuple, down: tuple, rng: np.random.Generator, per_m: int = 110) -> Quad:
    """A plastered wall with posters."""
    rows, columns = (int(per_m * np.linalg.norm(v)) for v in (down, along))
    image = textures.mottled(rows, columns, rng.uniform(150, 205, 3), rng, strength=2.5)
    for c in range(int(0.3 * per_m), columns - int(1.2 * per_m), int(1.5 * per_m)):
        h, w = (rng.uniform(low, high) for low, high in ((0.65, 1.0), (0.6, 1.1)))
        poster = textures.poster(int(per_m * h), int(per_m * w), rng)
        r = int(rng.uniform(0.15, 0.9) * (rows - poster.shape[0] - per_m))
        image[r : r + poster.shape[0], c : c + poster.shape[1]] = poster
    return quad(corner, along, down, image)


def room(seed: int, half: float = 4.0) -> Scene:
    """Four walls with posters, a floor, and furniture along them and between."""
    rng, top, high = np.random.default_rng((seed, 2)), -1.2, 1.2 + EYE
    a, d = half, 2 * half
    sides = (((-a, a), (d, 0)), ((a, a), (0, -d)), ((a, -a), (-d, 0)), ((-a, -a), (0, d)))
    quads = [_wall((x, top, z), (u, 0, w), (0, high, 0), rng) for (x, z), (u, w) in sides]
    floor = textures.wood(int(60 * d), int(60 * d), rng)
    quads.append(quad((-a, EYE, a), (d, 0, 0), (0, 0, -d), floor))
    for k in range(12):  # around the middle, which is left free
        angle, r = 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / 12, rng.uniform(2.3, 3.2)
        w, h, deep = rng.uniform(0.35, 0.8), rng.uniform(0.5, 1.5), rng.uniform(0.3, 0.6)
        colour = rng.uniform(60, 200, 3)
        faces = [textures.printed(int(150 * h), int(150 * w), colour, rng) for _ in range(6)]
        quads += box((r * np.sin(angle), EYE - h / 2, r * np.cos(angle)), (w, h, deep), rng.uniform(-0.6, 0.6), faces)
    return Scene(tuple(quads), (200, 205, 208))


def _columns(*x: np.ndarray) -> np.ndarray:
    return np.stack(np.broadcast_arrays(*x), axis=1).astype(float)


def _stroll(n: int, seed: int, *, yaw: float = 0.0, side: float = 1.0) -> np.ndarray:
    """Sideways through the middle of a room, by hand, 2 cm a frame, looking across."""
    s = np.arange(n) - (n - 1) / 2
    c, w = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    across, ahead = 0.02 * side * s, 0.15 * np.sin(s / 30) - 1.0
    place = _columns(c * across + w * ahead, 0.05 * np.sin(s / 25), c * ahead - w * across)
    return by_hand(place, _columns(yaw - 8 * side * np.sin(s / 60), -4 + 0 * s, 0 * s), seed)


def crowd(n: int, seed: int) -> Situation:
    """Six people, boxes of clothes, who cross 2 to 3.3 m before the camera at 0.5 to 1.4 m/s."""
    rng, still, T = np.random.default_rng((seed, 3)), room(seed), _stroll(n, seed)
    people = []
    for k in range(6):
        colour = rng.uniform(50, 190, 3)
        clothes = [textures.mottled(170, 60, colour, rng, strength=11.0) for _ in range(6)]
        ways = rng.choice([-1, 1]) * rng.uniform(0.02, 0.056), rng.uniform(-3, 3), 1.0 + 0.25 * k
        people.append((clothes, *ways, rng.uniform(0, 6)))

    def scene(k: int) -> Scene:
        quads = []
        for clothes, speed, x, z, phase in people:
            at = (x + speed * k + 3.5) % 7 - 3.5
            bob = 0.03 * np.sin(0.5 * k + phase)
            quads += box((at, EYE - 0.85 + bob, z), (0.5, 1.7, 0.3), 0.2 * np.sin(0.25 * k + phase), clothes)
        return Scene((*still.quads, *quads), still.background)

    return Situation(pinhole(), film(scene, pinhole(), T, seed), T, "tracking: the room is what stands", shown=n // 2)


def _shots(seed: int, second: Scene, T: np.ndarray, n: int, mixed: int) -> tuple[Images, np.ndarray]:
    """A room, then another shot along T, with so many frames that show both."""
    A = _stroll(n + mixed, seed)
    old, new = film(room(seed), pinhole(), A, seed), film(second, pinhole(), T, seed + 1)

    def images() -> Images:
        for _ in range(n):
            yield next(old)
        for i in range(mixed):
            share = (i + 1) / (mixed + 1)
            yield cv2.addWeighted(next(old), 1 - share, next(new), share, 0)
        yield from new

    half = mixed // 2  # the truth is that of the shot that is seen more of
    return images(), np.concatenate([A[: n + half], T[half:]])


def dissolve(n: int, seed: int) -> Situation:
    """Two rooms, one dissolving into the other over 20 frames."""
    each, mixed = (n - 20) // 2, 20
    T = _stroll(each + mixed, seed + 1, side=-1.0)
    T = AWAY @ T
    images, truth = _shots(seed, transform(room(seed + 100), AWAY), T, each, mixed)
    says = "mixed frames not tracking, then a new scale"
    return Situation(pinhole(), images, truth, says, ((each, each + mixed - 1),), each + mixed // 2)


def same_room_cut(n: int, seed: int) -> Situation:
    """A cut to the other side of the room."""
    images, truth = _shots(seed, room(seed), _stroll(n // 2, seed + 1, yaw=130.0, side=-1.0), n // 2, 0)
    return Situation(pinhole(), images, truth, "lost at the cut, then a new scale", ((n // 2, n // 2),), n // 2)


def other_room_cut(n: int, seed: int) -> Situation:
    """A cut to another room."""
    T = _stroll(n // 2, seed + 1, side=-1.0)
    T = AWAY @ T
    images, truth = _shots(seed, transform(room(seed + 100), AWAY), T, n // 2, 0)
    return Situation(pinhole(), images, truth, "lost at the cut, then a new scale", ((n // 2, n // 2),), n // 2)


def hand(n: int, seed: int) -> Situation:
    """A hand, out of focus, that comes within three frames, covers the lens for ten, and goes."""
    camera, T, first = pinhole(), _stroll(n, seed), n // 2 - 5
    rng = np.random.default_rng((seed, 4))
    skin = textures.mottled(300, 420, SKIN, rng, strength=9.0, finest=12)
    skin = cv2.GaussianBlur(skin, (0, 0), 4).astype(float)

    def put(k: int, image: np.ndarray) -> np.ndarray:
        seen = min(k - first + 3, first + 12 - k, 3)  # quarters of the picture, less one
        if seen < 0:
            return image
        dx, dy = (int(30 + 12 * np.sin(0.6 * k + p)) for p in (0, 2))
        over = skin[dy : dy + 240, dx : dx + 320]
        ramp = ((seen + 1) * 90 - np.arange(320)[::-1]) / 25  # a soft edge, which comes from the right
        alpha = np.clip(ramp, 0, 1)[None, :, None]
        return image * (1 - alpha) + over * alpha

    images = film(room(seed), camera, T, seed, put)
    return Situation(
        camera, images, T, "ten frames not tracking, then found again at the scale of before", shown=first - 2
    )


def room_twice(n: int, seed: int) -> Situation:
    """Two rounds on a circle in the middle of a room, looking outwards."""
    angle = 4 * np.pi * np.arange(n) / (n - 1)
    place = _columns(1.3 * np.sin(angle), 0.03 * np.sin(5 * angle), 1.3 * np.cos(angle))
    T = by_hand(place, _columns(np.degrees(angle), -6 + 0 * angle, 0 * angle), seed)
    return Situation(pinhole(), film(room(seed), pinhole(), T, seed), T, "tracking, one scale", shown=n // 8)


def stop_and_go(n: int, seed: int) -> Situation:
    """Three times 40 % of the way stands still, but for the hand."""
    u = np.arange(n) / n * 3 % 1
    speed = 0.035 * np.clip(np.minimum(u, 0.6 - u) / 0.08, 0, 1)
    s = np.cumsum(speed) - speed.sum() / 2
    T = by_hand(_columns(s, 0 * s, -1 + 0.2 * s), _columns(-5 * s, -4 + 0 * s, 0 * s), seed)
    return Situation(pinhole(), film(room(seed), pinhole(), T, seed), T, "tracking, one scale", shown=n // 4)


def rotation_midway(n: int, seed: int) -> Situation:
    """A third of the frames turn on the spot, by 40 of the 59 degrees that it sees; the others move."""
    third, t = n // 3, np.arange(n)
    turned = np.clip((t - third) / third, 0, 1)
    x = 0.02 * (np.minimum(t, third) + np.maximum(t - 2 * third, 0)) - 0.02 * third
    place = _columns(x, 0.03 * np.sin(x * 6), -0.8 + 0 * x)
    T = poses(place, _columns(-20 + 40 * turned * turned * (3 - 2 * turned), -4 + 0 * x, 0 * x))
    return Situation(pinhole(), film(room(seed), pinhole(), T, seed), T, "tracking, one scale", shown=n // 2)


def rolling_shutter(n: int, seed: int) -> Situation:
    """A hand that shakes, and rows read one after another within 20 ms; the truth is that of the middle row."""
    bands = 12
    delay = 0.020 * ((np.arange(bands) + 0.5) / bands - 0.5)
    times = (np.arange(n)[:, None] / FPS + delay).ravel()

    def at(seconds: np.ndarray) -> np.ndarray:
        s = seconds * FPS - n / 2
        shift, turn = tremor(seconds, seed, degrees=1.2)
        place = _columns(0.02 * s, 0.03 * np.sin(s / 20), -1 + 0 * s)
        return poses(place + shift, _columns(-6 * np.sin(s / 50), -4 + 0 * s, 0 * s) + turn)

    images = film(room(seed), pinhole(), at(times).reshape(n, bands, 4, 4), seed)
    says = "tracking or uncertain; the errors as stated"
    return Situation(pinhole(), images, at(np.arange(n) / FPS), says, shown=n // 2)


def rolling_told(n: int, seed: int) -> Situation:
    """The same, with a camera that says so."""
    seen = rolling_shutter(n, seed)
    return seen._replace(camera=seen.camera.rolling(0.0, 0.020), expected="tracking; the errors as stated")


def there_and_back(n: int, seed: int) -> Situation:
    """Along a corridor, 4 cm a frame, half looking at its wall, and back on the same way, looking the same."""
    rng, part = np.random.default_rng((seed, 5)), 5.0
    s = 0.04 * np.minimum(np.arange(n), n - 1 - np.arange(n))
    parts = []
    for k in range(-2, int(s.max() / part) + 4):
        z, quads = part * k, []
        quads.append(_wall((1.2, -1.2, z + part), (0, 0, -part), (0, 1.2 + EYE, 0), rng))
        quads.append(_wall((-1.2, -1.2, z), (0, 0, part), (0, 1.2 + EYE, 0), rng))
        floor = textures.mottled(300, 144, (120, 125, 130), rng, strength=5.0)
        quads.append(quad((-1.2, EYE, z + part), (2.4, 0, 0), (0, 0, -part), floor))
        face = [textures.printed(120, 60, rng.uniform(60, 200, 3), rng) for _ in range(6)]
        size = (0.4, rng.uniform(0.5, 1.3), 0.4)
        quads += box((0.95, EYE - size[1] / 2, z + rng.uniform(1, 4)), size, 0.2, face)
        parts.append((z, quads))

    def scene(k: int) -> Scene:
        near = (quads for z, quads in parts if s[k] - 2 * part < z < s[k] + 3 * part)
        return Scene(tuple(q for quads in near for q in quads), (170, 172, 175))

    T = by_hand(_columns(-0.3 + 0 * s, 0 * s, s), _columns(40 + 5 * np.sin(s / 3), -3 + 0 * s, 0 * s), seed)
    return Situation(pinhole(), film(scene, pinhole(), T, seed), T, "tracking, one scale", shown=n // 4)


# ---------------------------------------------------------------- a road


def _road(length: float, rng: np.random.Generator) -> list[Quad]:
    """A motorway with lanes, low walls, trees, poles, bridges and signs."""
    quads, per_m, part = [], 10, 100
    for s in range(int(length / part) + 1):
        rows, columns = part * per_m, 24 * per_m
        grain = cv2.GaussianBlur(rng.normal(0, 1, (rows, columns)), (0, 0), 1.2)
        grain = 92 + 4 * grain / grain.std() + cv2.resize(rng.normal(0, 3, (rows // 40, columns // 8)), (columns, rows))
        for x in (-5.4, -1.8, 1.8, 5.4):
            c = int((x + 12) * per_m)
            if abs(x) > 5:
                grain[:, c - 1 : c + 1] = 210
            else:
                for d in range(0, part, 12):
                    grain[d * per_m : (d + 3) * per_m, c - 1 : c + 2] = 215
        image = np.repeat(grain.clip(0, 255)[..., None], 3, 2).astype(np.uint8)
        quads.append(quad((-12, EYE, (s + 1) * part), (24, 0, 0), (0, 0, -part), image))
    for s in range(int(length / 50) + 1):
        for x, z, dz in ((-12, 50 * s, 50), (12, 50 * s + 50, -50)):
            wall = textures.mottled(24, 600, (120, 135, 140), rng, strength=3.0)
            quads.append(quad((x, EYE - 0.8, z), (0, 0, dz), (0, 0.8, 0), wall))
    for k in range(int(length / 13)):
        h, place = rng.uniform(4, 9), rng.choice([-1, 1]) * rng.uniform(16, 32)
        crown = cv2.GaussianBlur(rng.normal(0, 1, (120, 100)), (0, 0), 2)
        crown = (26 * crown / crown.std() + 70)[..., None] * [0.45, 0.75, 0.55]
        where, size = (place, EYE - h / 2, 13 * k + rng.uniform(-4, 4)), (rng.uniform(3, 7), h, rng.uniform(2, 4))
        quads += box(where, size, rng.uniform(-0.4, 0.4), [crown.clip(0, 255).astype(np.uint8)] * 6)
    for z in np.arange(15, length, 28):
        for x in (-12.6, 12.6):
            quads += box((x, -3.0, z), (0.22, 9, 0.22), 0, [textures.plain(4, 4, (70, 74, 78))] * 6)
    for z in np.arange(110, length, 180):
        face = textures.mottled(40, 700, (105, 110, 115), rng, strength=5.0)
        quads += box((0, -5.1, z), (46, 1.6, 9), 0, [face] * 6)
    for k, z in enumerate(np.arange(80, length, 110)):
        quads += box((9.5 - 18 * (k % 2), -3.1, z), (5, 2.4, 0.2), 0, [textures.poster(160, 330, rng)] * 6)
    return quads


Car = Callable[[int], tuple[float, float]]  # x and z before the camera of a frame, metres


def _drive(n: int, seed: int, z: np.ndarray, cars: list[Car], expected: str) -> Situation:
    """A camera at z (n,) along the road, with a change of lane, behind and beside cars."""
    rng, camera = np.random.default_rng((seed, 6)), pinhole(229.0)
    quads = _road(z[-1] + 150, rng)
    paint = [[textures.printed(150, 190, rng.uniform(40, 170, 3), rng) for _ in range(6)] for _ in cars]
    u = np.clip((np.arange(n) - 0.6 * n) / (0.3 * n), 0, 1)
    place = _columns(-3.6 * u * u * (3 - 2 * u), 0.01 * np.sin(0.6 * np.arange(n)), z)
    yaw = np.degrees(np.arctan2(np.gradient(place[:, 0]), np.gradient(z)))
    T = poses(place, _columns(yaw, 0.12 * np.sin(0.5 * np.arange(n)), 0 * z))

    def scene(k: int) -> Scene:
        near = [q for q in quads if q.corner[2] > z[k] - 60]
        for car, faces in zip(cars, paint, strict=True):
            x, ahead = car(k)
            near += box((x, EYE - 0.65, z[k] + ahead), (1.8, 1.3, 4.2), 0, faces)
        return Scene(tuple(near), (235, 215, 190))

    return Situation(camera, film(scene, camera, T, seed), T, expected, shown=n // 2)


def _cruise(n: int) -> np.ndarray:
    return 25 / FPS * np.arange(n)  # 25 m/s


def highway_empty(n: int, seed: int) -> Situation:
    """A motorway at 25 m/s, no other car."""
    return _drive(n, seed, _cruise(n), [], "tracking, one scale")


def highway_traffic(n: int, seed: int) -> Situation:
    """The same behind a car ahead, with five more in other lanes that drive along or pull away."""
    rng = np.random.default_rng((seed, 7))
    gap = rng.uniform([9, 10, 12, 14, 26, 28], [13, 16, 18, 24, 36, 38])
    drift = rng.uniform([-0.03, -0.03, -0.03, -0.03, 0.03, 0.03], [0.03, 0.03, 0.03, 0.03, 0.1, 0.1])
    lanes = (0.0, -3.6, 3.6, -7.2, -3.6, 3.6)
    cars: list[Car] = [lambda k, i=i: (lanes[i], gap[i] + drift[i] * k) for i in range(6)]
    return _drive(n, seed, _cruise(n), cars, "tracking the road, not the cars")


def highway_light(n: int, seed: int) -> Situation:
    """The same with two cars that overtake, one after the other."""
    rng = np.random.default_rng((seed, 8))
    begin, speed = rng.uniform([-8, -30], [0, -20]), rng.uniform(0.15, 0.3, 2)
    cars: list[Car] = [lambda k, i=i: ((3.6, -7.2)[i], begin[i] + speed[i] * k) for i in range(2)]
    return _drive(n, seed, _cruise(n), cars, "tracking, one scale")


def lead_brakes(n: int, seed: int) -> Situation:
    """A car ahead keeps 18 m, then brakes at 3 m/s^2; half a second later the camera's car does."""
    begun, late = 0.4 * n, 12

    def way(k: np.ndarray | float, start: float) -> np.ndarray:
        return 25 / FPS * np.asarray(k) - 1.5 * (np.maximum(np.asarray(k) - start, 0) / FPS) ** 2

    lead: Car = lambda k: (0.0, float(18 + way(k, begun) - way(k, begun + late)))  # noqa: E731
    return _drive(n, seed, way(np.arange(n), begun + late), [lead], "tracking the road, not the car")
