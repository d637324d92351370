"""Procedural textures with corners at several scales, BGR uint8, from a random generator."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

Colour = Sequence[float] | np.ndarray
"""Blue, green, red, 0 to 255."""

INKS = np.array(
    [
        (60, 40, 190),
        (150, 80, 30),
        (50, 140, 60),
        (40, 160, 230),
        (120, 60, 120),
        (40, 40, 40),
        (160, 150, 40),
    ]
)
PAPER = (228, 236, 240)


def plain(rows: int, columns: int, colour: Colour) -> UInt8[np.ndarray, "rows columns 3"]:
    """One colour."""
    return np.full((rows, columns, 3), np.asarray(colour), np.float64).astype(np.uint8)


def mottled(
    rows: int,
    columns: int,
    colour: Colour,
    rng: np.random.Generator,
    *,
    strength: float = 8.0,
    finest: int = 2,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """A colour with smooth noise of several octaves; `strength` is the deviation of each in gray levels."""
    image = np.empty((rows, columns, 3))
    image[:] = np.asarray(colour)
    cell = finest
    while cell < max(rows, columns):
        grid = rng.normal(size=(rows // cell + 2, columns // cell + 2))
        v, u = np.arange(rows) / cell, np.arange(columns) / cell
        image += strength * _bilinear(grid, v, u)[..., None]
        cell *= 4
    return image.clip(0, 255).astype(np.uint8)


def patches(
    rows: int, columns: int, rng: np.random.Generator, *, count: int = 900
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Overlapping rectangles of random colours, large ones first: strong corners at every scale."""
    image = np.empty((rows, columns, 3))
    image[:] = rng.uniform(60, 200, 3)
    for size in np.geomspace(0.35, 0.012, count) * min(rows, columns):
        h, w = np.maximum(size * rng.uniform(0.4, 1.6, 2), 3).astype(int)
        r, c = rng.integers(-h // 2, rows), rng.integers(-w // 2, columns)
        image[max(r, 0) : r + h, max(c, 0) : c + w] = rng.uniform(10, 245, 3)
    return image.astype(np.uint8)


def wood(rows: int, columns: int, rng: np.random.Generator) -> UInt8[np.ndarray, "rows columns 3"]:
    """A light table top: grain along the columns, in boards."""
    boards = np.arange(rows) * 6 // rows
    tone = rng.normal(scale=5, size=6)[boards][:, None]
    grain = sum(
        k * _bilinear(rng.normal(size=(rows // a + 2, columns // b + 2)), np.arange(rows) / a, np.arange(columns) / b)
        for k, a, b in ((7, 4, 90), (6, 12, 200), (3, 2, 30))
    )
    image = np.array([128, 168, 200]) + (tone + grain)[..., None] * np.array([1.1, 1.0, 0.9])
    image[np.flatnonzero(np.diff(boards))] *= 0.78
    return image.clip(0, 255).astype(np.uint8)


def write(image: np.ndarray, box: tuple[int, int, int, int], height: int, ink: Colour, rng: np.random.Generator):
    """Fill the box (first row, first column, rows, columns) of an image with lines of invented letters."""
    r0, c0, rows, columns = box
    stroke, line = max(height // 5, 1), int(1.7 * height)
    for r in range(r0, r0 + rows - height, line):
        c, stop = c0, c0 + columns - (rng.integers(0, columns // 3) if r + 2 * line > r0 + rows else 0)
        while c + height < stop:
            for _ in range(rng.integers(2, 9)):
                width = int(height * rng.uniform(0.35, 0.75))
                if c + width > stop:
                    break
                glyph = image[r : r + height, c : c + width]
                for part in rng.choice(5, rng.integers(2, 4), replace=False):
                    where = (
                        np.s_[:, :stroke], np.s_[:, -stroke:], np.s_[:stroke], np.s_[-stroke:],
                        np.s_[height // 2 : height // 2 + stroke],
                    )[part]  # fmt: skip
                    glyph[where] = ink
                c += width + stroke
            c += height // 2


def printed(rows: int, columns: int, colour: Colour, rng: np.random.Generator) -> UInt8[np.ndarray, "rows columns 3"]:
    """The printed face of a package: a band, a title, an emblem, small text and a bar code."""
    colour = np.asarray(colour, float)
    image = mottled(rows, columns, colour, rng, strength=3).astype(float)
    dark, light = 0.35 * colour, np.array([235.0, 240, 242])
    ink = INKS[rng.integers(len(INKS))]
    unit = min(rows, columns) // 16
    image[2 * unit : 5 * unit] = ink
    write(image, (int(2.7 * unit), unit, 3 * unit, columns - 2 * unit), int(1.6 * unit), light, rng)
    v, u = np.mgrid[:rows, :columns]
    r, c, radius = 0.55 * rows, 0.3 * columns, 0.2 * min(rows, columns)
    angle, distance = np.arctan2(v - r, u - c), np.hypot(v - r, u - c)
    image[distance < radius] = light
    image[distance < radius * (0.55 + 0.3 * np.sign(np.cos(rng.integers(3, 7) * angle)))] = ink
    image[distance < 0.15 * radius] = dark
    write(image, (int(0.42 * rows), int(0.56 * columns), int(0.3 * rows), int(0.4 * columns)), unit, dark, rng)
    top, left, wide = rows - 4 * unit, int(0.6 * columns), int(0.32 * columns)
    image[top : top + 3 * unit, left : left + wide] = light
    bars = np.repeat(rng.random(wide // 4) < 0.5, 3)[: wide - unit]
    image[top + unit // 2 : top + 3 * unit - unit // 2, left + unit // 2 : left + unit // 2 + bars.size][:, bars] = 30
    write(image, (rows - 4 * unit, unit, 3 * unit, int(0.45 * columns)), max(unit // 2, 4), dark, rng)
    image[: unit // 3], image[:, : unit // 3], image[:, -unit // 3 :] = (
        0.8 * colour,
        0.85 * colour,
        0.85 * colour,
    )
    return image.clip(0, 255).astype(np.uint8)


def poster(rows: int, columns: int, rng: np.random.Generator) -> UInt8[np.ndarray, "rows columns 3"]:
    """A conference poster: a title, columns of text, figures of patches and a border."""
    image = np.empty((rows, columns, 3))
    image[:] = PAPER
    head, ink = rows // 7, INKS[rng.integers(len(INKS))]
    image[:head] = ink
    write(image, (head // 5, columns // 14, head // 2, columns * 6 // 7), head // 4, PAPER, rng)
    write(image, (head * 3 // 4, columns // 14, head // 4, columns // 2), head // 9, PAPER, rng)
    gap, third = columns // 30, (columns - columns // 10) // 3
    for k in range(3):
        c, r = columns // 30 + k * (third + gap), head + gap
        while r + third // 2 < rows - gap:
            tall = min(int(third * rng.uniform(0.5, 0.9)), rows - gap - r)
            if rng.random() < 0.5:
                image[r : r + tall, c : c + third] = patches(tall, third, rng, count=60)
            else:
                write(image, (r, c, tall, third), max(rows // 60, 5), (50, 50, 50), rng)
            r += tall + gap
    edge = max(rows // 120, 2)
    image[:edge] = image[-edge:] = image[:, :edge] = image[:, -edge:] = 0.5 * ink
    return image.astype(np.uint8)


def page(rows: int, columns: int, rng: np.random.Generator) -> UInt8[np.ndarray, "rows columns 3"]:
    """A sheet of paper with text and one figure."""
    image = plain(rows, columns, PAPER)
    m = columns // 10
    write(image, (m, m, rows // 8, columns - 2 * m), rows // 20, (40, 40, 40), rng)
    write(image, (rows // 5, m, rows * 7 // 10, columns - 2 * m), rows // 45, (70, 70, 70), rng)
    image[rows // 2 : rows * 3 // 4, m:-m] = patches(rows * 3 // 4 - rows // 2, columns - 2 * m, rng, count=40)
    return image


def checks(
    rows: int, columns: int, squares: tuple[int, int], colours: tuple[Colour, Colour]
) -> UInt8[np.ndarray, "rows columns 3"]:
    """A board of (down, across) squares in two colours."""
    v, u = np.mgrid[:rows, :columns]
    odd = (v * squares[0] // rows + u * squares[1] // columns) % 2
    return np.asarray(colours, np.uint8)[odd]


def spines(rows: int, columns: int, rng: np.random.Generator) -> UInt8[np.ndarray, "rows columns 3"]:
    """A row of books seen from the back."""
    image, c = np.full((rows, columns, 3), 35.0), 0
    while c < columns:
        width = min(int(rows * rng.uniform(0.1, 0.24)), columns - c)
        top = int(rows * rng.uniform(0.0, 0.16))
        colour = INKS[rng.integers(len(INKS))] * rng.uniform(0.7, 1.25) + rng.uniform(0, 40)
        book = image[top:, c : c + max(width - 2, 1)]
        book[:] = colour * np.interp(np.arange(book.shape[1]), [0, width / 3, width], [0.8, 1.1, 0.75])[:, None]
        for at in rng.uniform(0.05, 0.9, 3):
            book[int(at * book.shape[0]) :][: rows // 40] = PAPER if rng.random() < 0.6 else 0.4 * colour
        title = np.array(book[int(0.3 * book.shape[0]) : int(0.75 * book.shape[0])].transpose(1, 0, 2))
        write(title, (width // 3, 4, width // 2 + 2, title.shape[1] - 4), max(width // 3, 3), PAPER, rng)
        book[int(0.3 * book.shape[0]) : int(0.75 * book.shape[0])] = title.transpose(1, 0, 2)
        c += width
    return image.clip(0, 255).astype(np.uint8)


def shade(image: np.ndarray, factor: float | np.ndarray) -> UInt8[np.ndarray, "rows columns 3"]:
    """The image under another light: one factor, or one per texel."""
    return (image * np.asarray(factor)[..., None]).clip(0, 255).astype(np.uint8)


def _bilinear(grid: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    i, j = v.astype(int), u.astype(int)
    fv, fu = (v - i)[:, None], u - j
    rows = grid[i] * (1 - fv) + grid[i + 1] * fv
    return rows[:, j] * (1 - fu) + rows[:, j + 1] * fu
