"""Frames in words."""

import numpy as np
from jaxtyping import Bool


def ranges(mask: Bool[np.ndarray, " t"], most: int | None = None) -> str:
    """The True entries as ranges: 0-4, 9; `most` of them, and how many more there are."""
    at = np.flatnonzero(mask)
    groups = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if at.size else []
    said = ", ".join(f"{g[0]}-{g[-1]}" if len(g) > 1 else f"{g[0]}" for g in groups[:most])
    more = 0 if most is None else sum(len(g) for g in groups[most:])
    return f"{said} and {more} more" if more else said
