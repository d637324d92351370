"""Two views of a camera that stays where it is, turns, and changes its focal length; it must not pass for a motion.

On the host, by SciPy: it is asked for once a start, and compiling it would take longer than all starts of a run.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

DEPTH = math.log(4)  # what GRIC charges a model for each point that it gives a depth
HUBER = 2.0  # sigmas from which an error counts linearly
NEAREST = 1e-3  # cosine of a turned ray's angle to the axis, below which it is held there: 89.9 degrees


class Zoom(NamedTuple):
    """A turn and a zoom between two views: u2 = scale R u1.

    Attributes:
        turn: (3,) rotation vector of R, radians.
        scale: Focal length in the second view over that in the first.
        distance: (m,) squared distances of the points in both views, over sigma squared, as Sampson's is.
    """

    turn: Float[np.ndarray, "3"]
    scale: float
    distance: Float[np.ndarray, " m"]


def fit(u1: Float[np.ndarray, "n 2"], u2: Float[np.ndarray, "n 2"], mask: Bool[np.ndarray, " n"], sigma: float) -> Zoom:
    """The turn and zoom that two views of the m points in the mask agree on best; `u1`, `u2` are normalised."""
    from scipy.optimize import least_squares  # here: importing it takes longer than a start
    from scipy.spatial.transform import Rotation

    rays, seen = np.column_stack([u1[mask], np.ones(mask.sum())]), u2[mask]

    def residuals(x: np.ndarray) -> np.ndarray:
        y = rays @ Rotation.from_rotvec(x[:3]).as_matrix().T
        return ((math.exp(x[3]) * y[:, :2] / np.maximum(y[:, 2:], NEAREST) - seen) / sigma).ravel()

    x = least_squares(residuals, np.zeros(4), loss="huber", f_scale=HUBER).x
    scale = math.exp(x[3])
    # The first view's noise comes over enlarged.
    return Zoom(x[:3], scale, np.sum(residuals(x).reshape(-1, 2) ** 2, axis=1) / (1 + scale**2))


def explains(zoom: Zoom, rival: float, worst: float) -> bool:
    """Whether it explains its points as well as a motion whose cost is `rival`, the points' depths counted.

    Both costs are sums of squared distances over sigma squared, of `worst` at most. By Torr's geometric robust
    information criterion: a motion has a parameter more, and a depth for every point, which fits noise too.
    Source: Torr 1999, "Model selection for two view geometry".
    """
    n = len(zoom.distance)
    return float(np.minimum(zoom.distance, worst).sum()) < rival + n * DEPTH + math.log(4 * n)
