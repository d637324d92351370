"""Bars and overlays are found by themselves, and nothing else is."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from jaxtri.vision.klt import KLT, KLTSettings

SIZE = (240, 320)  # rows, columns
F = 280.0
K = np.array([[F, 0, 159.5], [0, F, 119.5], [0, 0, 1]])
SETTINGS = KLTSettings(capacity=300)
FRAMES = 45


def texture(seed: int, side: int = 900) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.zeros((side, side))
    for k in (5, 10, 20):
        image += cv2.resize(rng.random((side // k, side // k)), (side, side), interpolation=cv2.INTER_CUBIC)
    return (255 * (image - image.min()) / np.ptp(image)).astype(np.uint8)


WALL, OBJECT, FAR = texture(0), texture(1, 300), texture(2)


def seen(R: np.ndarray, t: np.ndarray, walls) -> np.ndarray:
    """Textured squares (texture, side, depth) across the z axis, farthest first, from a camera of pose `R`, `t`."""
    image = np.full(SIZE, 90, np.uint8)
    for square, side, depth in walls:
        m = side / len(square)
        to_world = np.array([[m, 0, -side / 2], [0, m, -side / 2], [0, 0, depth]])
        H = K @ (R @ to_world + np.outer(t, [0, 0, 1]))
        there = cv2.warpPerspective(np.full_like(square, 255), H, SIZE[::-1]) > 127
        image[there] = cv2.warpPerspective(square, H, SIZE[::-1])[there]
    return image


def turn(*degrees: float) -> np.ndarray:
    return cv2.Rodrigues(np.radians(degrees))[0]


def coded(images, noise: float = 1.5) -> list[np.ndarray]:
    """With the noise of a camera and of a code."""
    rng = np.random.default_rng(0)
    noisy = [(x + rng.normal(scale=noise, size=x.shape)).clip(0, 255).astype(np.uint8) for x in images]
    return [again(x) for x in noisy]


def again(image: np.ndarray) -> np.ndarray:
    return np.asarray(
        cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1], cv2.IMREAD_GRAYSCALE)
    )


def slide(frames: int = FRAMES) -> list[np.ndarray]:
    """A camera that slides along a wall, 3 pixels a frame."""
    return coded(seen(np.eye(3), np.array([-0.02 * k, 0.004 * k, 0]), [(WALL, 6, 2)]) for k in range(frames))


def orbit(axis: float) -> list[np.ndarray]:
    """A camera that circles a plane at a depth of 2 without any shake, and looks at an axis before or in it."""
    poses = []
    for a in np.radians(np.linspace(-25, 25, FRAMES)):
        centre = axis * np.array([np.sin(a), 0, 1 - np.cos(a)]) + [0, 0, 2 - axis]
        R = turn(0, np.degrees(a), 0)
        poses.append((R, -R @ centre))
    return coded(seen(R, t, [(WALL, 18, 6), (OBJECT, 0.8, 2)]) for R, t in poses)


def followed(images, settings: KLTSettings = SETTINGS):
    klt = KLT(settings)
    return klt, [klt.track(image) for image in images]


def inside(tracks, left: int, top: int, right: int, bottom: int) -> int:
    x, y = tracks.pixels[tracks.visible].T
    return int(((x >= left) & (x <= right) & (y >= top) & (y <= bottom)).sum())


def with_time_code(images) -> list[np.ndarray]:
    out = []
    for k, image in enumerate(images):
        marked = image.copy()
        cv2.rectangle(marked, (12, 200), (150, 228), 0, -1)
        cv2.putText(marked, f"11:52:07:{k:02d}", (16, 221), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 255, 2)
        out.append(again(marked))
    return out


def with_watermark(images) -> list[np.ndarray]:
    """Half transparent, before a wall of little contrast."""
    mark = np.zeros(SIZE, np.uint8)
    cv2.putText(mark, "SAMPLE", (70, 140), cv2.FONT_HERSHEY_SIMPLEX, 1.5, 255, 6)
    dull = [image // 3 + 60 for image in images]
    return [again(np.where(mark > 0, image // 2 + 127, image).astype(np.uint8)) for image in dull]


@pytest.mark.parametrize(
    ("mark", "box", "share"), [(with_time_code, (12, 200, 150, 228), 0.8), (with_watermark, (70, 104, 240, 142), 0.5)]
)
def test_what_stays_while_the_picture_moves_is_ignored(mark, box, share):
    klt, tracks = followed(mark(slide()))
    found = klt.found()
    assert {part.kind for part in found} == {"overlay"}
    assert min(part.first for part in found) < 25  # a second
    reach = 2 * SETTINGS.window
    for part in found:
        assert part.left > box[0] - reach
        assert part.right < box[2] + reach
        assert part.top > box[1] - reach
        assert part.bottom < box[3] + reach
        assert part.last is None
    assert inside(tracks[0], *box) > 10
    assert inside(tracks[-1], *box) <= (1 - share) * inside(tracks[0], *box)
    assert tracks[-1].visible.sum() > 0.7 * SETTINGS.capacity
    assert 0.01 < klt.ignored_share() < 0.2


def ahead() -> list[np.ndarray]:
    """A camera that goes straight on, without any shake, towards what is far behind a wall."""
    walls = [(FAR, 120, 40), (WALL[:, :400], 3, 3)]
    return coded(seen(np.eye(3), np.array([0, 0, -z]), walls) for z in np.linspace(0, 1, FRAMES))


def slide_before_a_far_view() -> list[np.ndarray]:
    """The lower half is near; the upper one, far away, moves by a shake of a quarter of a pixel alone."""
    rng, images = np.random.default_rng(3), []
    for k in range(FRAMES):
        R = turn(*rng.normal(scale=0.05, size=3))
        far, near = (
            seen(R, np.array([x * k, 0, 0]), [wall]) for x, wall in ((0, (FAR, 120, 40)), (-0.03, (WALL, 6, 2)))
        )
        images.append(np.vstack([far[:100], near[100:]]))
    return coded(images)


def turned(axis: int, most: float) -> list[np.ndarray]:
    """A camera that turns by so many degrees about an axis of its own."""
    angles = np.linspace(-most / 2, most / 2, FRAMES)[:, None] * np.eye(3)[axis]
    return coded(seen(turn(*a), np.zeros(3), [(WALL, 18, 6)]) for a in angles)


SCENES = {
    "stands": lambda: coded([seen(np.eye(3), np.zeros(3), [(WALL, 6, 2)])] * FRAMES),
    "slides": slide,
    "rolls": lambda: turned(2, 60),
    "turns": lambda: turned(1, 40),
    "goes ahead": ahead,
    "circles an object": lambda: orbit(2.0),
    "circles a point before it": lambda: orbit(1.6),
    "slides before a far view": slide_before_a_far_view,
}


@pytest.mark.parametrize("name", SCENES)
def test_nothing_is_found_in_a_scene_and_its_tracks_are_those_without_looking(name):
    images = SCENES[name]()
    klt, tracks = followed(images)
    assert klt.found() == []
    assert klt.ignored_share() == 0
    _, plain = followed(images, replace(SETTINGS, find_overlays=False))
    for one, other in zip(tracks, plain, strict=True):
        for x, y in zip(one, other, strict=True):
            np.testing.assert_array_equal(x, y)


def test_an_overlay_ends_where_the_picture_moves_again():
    """A camera waits, most of the picture is a lorry that passes; then it goes on."""
    wall = slide(90)
    lorry = slide(30)
    waiting = [np.vstack([wall[0][:90], x[90:]]) for x in lorry]
    klt, tracks = followed([*waiting, *wall])
    found = klt.found()
    assert found
    assert all(30 < part.last < 80 for part in found if part.last is not None)
    assert sum(part.last is None for part in found) <= len(found) // 4
    assert inside(tracks[29], 0, 0, 320, 70) < 20
    assert inside(tracks[-1], 0, 0, 320, 70) > 50


def barred(images, box: tuple[int, int, int, int], colour: int = 0) -> list[np.ndarray]:
    left, top, right, bottom = box
    out = []
    for image in images:
        framed = np.full_like(image, colour)
        framed[top:bottom, left:right] = image[top:bottom, left:right]
        out.append(again(framed))
    return out


@pytest.mark.parametrize("colour", [0, 235])
@pytest.mark.parametrize("box", [(0, 30, 320, 205), (45, 0, 275, 240)])
def test_bars_are_found_and_their_edges_hold_no_features(box, colour):
    left, top, right, bottom = box
    klt, tracks = followed(barred(slide(30), box, colour))
    bars = [part for part in klt.found() if part.kind == "bar"]
    edges = [(0, 0, 319, top - 1), (0, bottom, 319, 239)] if top else [(0, 0, left - 1, 239), (right, 0, 319, 239)]
    assert [part[1:5] for part in bars] == edges
    assert all(part.first == 0 if colour == 0 else 0 < part.first < 28 for part in bars)
    assert klt.found() == bars
    reach = SETTINGS.window // 2
    x, y = tracks[-1].pixels[tracks[-1].visible].T
    assert len(x) > 100
    assert left == 0 or (x > left + reach - 1).all()
    assert right == 320 or (x < right - reach).all()
    assert top == 0 or (y > top + reach - 1).all()
    assert bottom == 240 or (y < bottom - reach).all()


def test_a_bar_ends_where_something_is_seen_in_it():
    """The black of a night above a straight roof, until a lamp comes."""
    wall = slide(40)
    night = barred(wall, (0, 60, 320, 240))
    for image in night[20:]:
        image[10:50] = wall[0][10:50]
    klt, tracks = followed(night)
    (bar,) = (part for part in klt.found() if part.kind == "bar" and part.last is not None)
    assert (bar.top, bar.bottom, bar.first, bar.last) == (0, 59, 0, 19)
    assert inside(tracks[19], 0, 0, 320, 59) == 0
    assert inside(tracks[20], 0, 15, 320, 45) > 20


def test_neither_a_fade_nor_a_level_horizon_is_a_bar():
    wall = slide(40)
    fade = [(image * min(k / 10, 1)).astype(np.uint8) for k, image in enumerate(wall)]
    klt, _ = followed(fade)
    assert klt.found() == []
    assert klt.ignored_share() == 0
    # A camera that nods below an overexposed sky.
    rows = 70 + (20 * np.sin(np.arange(40))).astype(int)
    klt, _ = followed(
        [np.vstack([np.full((n, 320), 255, np.uint8), x[: 240 - n]]) for n, x in zip(rows, wall, strict=True)]
    )
    assert klt.found() == []
