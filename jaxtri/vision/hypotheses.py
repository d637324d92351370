"""Relative poses of two views: hypotheses from OpenCV, refined by maximum likelihood."""

from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SO3
from jaxtyping import Array, Bool, Float

from jaxtri.errors import JaxtriError
from jaxtri.estimation import two_view
from jaxtri.geometry.epipolar import essential, inverse_depth, parallax, sampson

HYPOTHESES = 8  # their number is fixed, so that one compilation serves
CONFIDENCE = 0.9999  # that a robust estimator drew a sample without outliers: a start is rare, so it may take time
LEAST = 8  # tracks: what the 8-point algorithm needs, and fewer leave a pose with hardly anything to be judged by
DRAWS = 1000  # samples of a resection, at most: with half of the points wrong a tenth would do
GATE = 4.0  # sigmas of Sampson distance within which a track agrees; beyond, all cost the same
# Quantiles of flow and parallax by which motion is judged: that of half of the tracks, or FARTHER times that of a
# quarter. What is far behind, or goes along with the camera, shows none, and may be most of what is seen.
SHARES, FARTHER = (0.5, 0.75), 1.4
WORST = 4.0  # times the cost of the best, above which a hypothesis is not refined a second time
AHEAD = 0.9  # share of a plane's points that must lie before the camera: the rest may be noise
FOCAL = 1000.0  # pixels, of the made-up camera for estimators whose own thresholds are made for pixels
SHORTEST = 1e-9  # length of a translation that counts as none
# Radians, and length of the difference of unit translations, below which two hypotheses are the same: refined from
# different starts, one minimum is found to about so much.
SAME_TURN, SAME_DIRECTION = 1e-3, 2e-2


class Hypothesis(NamedTuple):
    """A refined relative pose, what it costs, and which tracks agree with it.

    Attributes:
        pose: The relative pose, its translation of unit length.
        cost: Sum over the common tracks of the squared Sampson distances over sigma; 16 for a track that does not
            agree.
        inside: (n,) tracks within 4 sigmas and in front of both cameras.
        parallax_deg: Angle in degrees between the two rays of a track that half of these exceed, or a quarter 1.4
            times.
    """

    pose: two_view.TwoView
    cost: float
    inside: np.ndarray
    parallax_deg: float


def essential_poses(u1: np.ndarray, u2: np.ndarray, threshold: float, *, eight_point: bool = False) -> list:
    """Relative poses (R, T) from robust essential matrices; empty where OpenCV finds none.

    `u1` and `u2` (n, 2) are normalised points, `threshold` is in the same units. With `eight_point` it is the paper's
    way: the 8-point algorithm inside RANSAC (Yu et al. 2006, section III).
    """
    found = []
    for method in (cv2.FM_RANSAC,) if eight_point else (cv2.USAC_MAGSAC, cv2.RANSAC):
        try:
            if eight_point:
                E = _eight_point(u1, u2, threshold)
            else:
                E, _ = cv2.findEssentialMat(u1, u2, np.eye(3), method=method, prob=CONFIDENCE, threshold=threshold)
        except cv2.error:  # a degenerate sample: no hypothesis
            continue
        if E is None or not np.isfinite(E).all():
            continue
        for stacked in E.reshape(-1, 3, 3):  # the five-point solver may return several
            # Points beyond 50 base lines are dropped by default, which at video rate is nearly all of them.
            _, R, T, _, _ = cv2.recoverPose(stacked, u1, u2, np.eye(3), distanceThresh=1e9)
            found.append((R, T.ravel()))
    return found


def poselib_poses(u1: np.ndarray, u2: np.ndarray, threshold: float) -> list:
    """The relative pose (R, T) by PoseLib's LO-RANSAC; empty where it finds none.

    Raises `JaxtriError` where PoseLib is not installed (extra `init`).
    """
    try:
        import poselib  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise JaxtriError("starts by PoseLib need it: python -m pip install 'jaxtri[init]'") from None
    # PoseLib's refinement is scaled for pixels.
    size = int(2 * FOCAL)
    camera = {"model": "PINHOLE", "width": size, "height": size, "params": [FOCAL, FOCAL, 0.0, 0.0]}
    options = {"max_epipolar_error": FOCAL * threshold}
    pose, _ = poselib.estimate_relative_pose(FOCAL * u1, FOCAL * u2, camera, camera, options, {})
    length = np.linalg.norm(pose.t)
    found = np.isfinite(pose.R).all() and np.isfinite(length) and length > SHORTEST
    return [(np.asarray(pose.R), np.asarray(pose.t) / length)] if found else []


def _eight_point(u1: np.ndarray, u2: np.ndarray, threshold: float) -> np.ndarray | None:
    """Essential matrix by RANSAC over 8-point samples, then the 8-point fit to all inliers."""
    # OpenCV's own RANSAC expects pixels.
    F, mask = cv2.findFundamentalMat(u1 * FOCAL, u2 * FOCAL, cv2.FM_RANSAC, threshold * FOCAL, CONFIDENCE)
    if F is None or F.shape != (3, 3) or mask is None or mask.sum() < LEAST:
        return None
    inside = mask.ravel() == 1
    F, _ = cv2.findFundamentalMat(u1[inside] * FOCAL, u2[inside] * FOCAL, cv2.FM_8POINT)
    if F is None or F.shape != (3, 3):
        return None
    S = np.diag([FOCAL, FOCAL, 1.0])
    U, _, Vt = np.linalg.svd(S @ F @ S)
    return U @ np.diag([1.0, 1.0, 0.0]) @ Vt


def resection(X: np.ndarray, u: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray] | None:
    """The pose (4, 4), world to camera, that most points X (n, 3) agree with, and which (n,) do; None if none is found.

    `u` (n, 2) are normalised, `threshold` is in the same units.
    """
    if len(X) < LEAST:
        return None
    options = {"reprojectionError": FOCAL * threshold, "confidence": CONFIDENCE, "iterationsCount": DRAWS}
    try:
        ok, turn, shift, rows = cv2.solvePnPRansac(
            X, FOCAL * u, np.diag([FOCAL, FOCAL, 1.0]), None, flags=cv2.SOLVEPNP_SQPNP, **options
        )
    except cv2.error:  # points in one place
        return None
    if not ok or rows is None or len(rows) < LEAST:
        return None
    rows = np.asarray(rows, int).ravel()
    turn, shift = cv2.solvePnPRefineLM(X[rows], FOCAL * u[rows], np.diag([FOCAL, FOCAL, 1.0]), None, turn, shift)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return (T, np.isin(np.arange(len(X)), rows)) if np.isfinite(T).all() else None


def homography_poses(u1: np.ndarray, u2: np.ndarray, threshold: float) -> list:
    """Relative poses (R, T) of a plane that fills the view; empty where there is none, or no translation."""
    try:
        H, mask = cv2.findHomography(u1, u2, cv2.USAC_MAGSAC, threshold, maxIters=2000, confidence=CONFIDENCE)
    except cv2.error:
        return []
    if H is None or mask is None or mask.sum() < LEAST:
        return []
    _, rotations, translations, normals = cv2.decomposeHomographyMat(H, np.eye(3))
    x1 = np.c_[u1, np.ones(len(u1))][mask.ravel() == 1]
    found = []
    for R, T, n in zip(rotations, translations, normals, strict=True):
        ahead = np.mean(x1 @ n.ravel() > 0) > AHEAD  # the plane lies in front of the first camera
        if ahead and np.linalg.norm(T) > SHORTEST:
            found.append((R, T.ravel() / np.linalg.norm(T)))
    return found


class _Refined(NamedTuple):
    pose: two_view.TwoView
    cost: Float[Array, ""]
    inside: Bool[Array, " n"]
    parallax: Float[Array, ""]


@jax.jit
def _refine(
    R: Float[Array, "h 3 3"],
    T: Float[Array, "h 3"],
    u1: Float[Array, "n 2"],
    u2: Float[Array, "n 2"],
    mask: Bool[Array, "h n"],
    wanted: Bool[Array, " h"],
    common: Bool[Array, " n"],
    sigma: Float[Array, ""],
) -> _Refined:
    """Every wanted hypothesis, refined on its own tracks and judged on all common ones; the unwanted cost infinity."""

    def one(R: Array, T: Array, mask: Array) -> _Refined:
        pose = two_view.refine(T, SO3.from_matrix(R), u1, u2, mask, sigma)
        R, T = pose.rotation.as_matrix(), pose.translation
        distance = jax.vmap(lambda a, b: sampson(essential(R, T), a, b))(u1, u2) / sigma
        inverse = jax.vmap(lambda a, b: inverse_depth(a, b, R, T, T))(u1, u2)
        inside = common & (jnp.abs(distance) < GATE) & (inverse > 0)
        cost = jnp.sum(jnp.where(common, jnp.where(inside, distance**2, GATE**2), 0.0))
        angle = jax.vmap(lambda a, b: parallax(a, b, R))(u1, u2)
        half, quarter = jnp.nanquantile(jnp.where(inside, angle, jnp.nan), jnp.asarray(SHARES, angle.dtype))
        return _Refined(pose, cost, inside, jnp.maximum(half, quarter / FARTHER))

    def refine(hypothesis: tuple[Array, Array, Array, Array]) -> _Refined:
        wanted, *others = hypothesis
        shapes = jax.eval_shape(one, *others)
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)._replace(
            cost=jnp.asarray(jnp.inf, R.dtype)
        )
        return jax.lax.cond(wanted, one, lambda *_: nothing, *others)

    # A loop, not a batch: it compiles in half the time, and this is what a first run waits for.
    return jax.lax.map(refine, (wanted, R, T, mask))


def hypotheses(
    u1: np.ndarray,
    u2: np.ndarray,
    mask: np.ndarray,
    sigma: Array,
    threshold: float,
    *,
    eight_point: bool = False,
    poselib: bool = False,
) -> list[Hypothesis]:
    """Relative poses that may explain two views, refined, different from each other, the best first.

    `u1`, `u2` (n, 2) are normalised points in slots with noise `sigma`, `mask` (n,) marks those seen in both;
    `threshold` is that of the robust estimators, in normalised units. Essential matrices and the decomposition of a
    homography compete, so that a plane (which has two poses) and a general scene are both served. With `eight_point`
    there is the paper's way alone; with `poselib` PoseLib's pose competes, too. Empty where nothing fits.
    """
    a, b = u1[mask].astype(np.float64), u2[mask].astype(np.float64)
    if len(a) < LEAST:
        return []
    poses = essential_poses(a, b, threshold, eight_point=eight_point)
    if not eight_point:
        poses += (poselib_poses(a, b, threshold) if poselib else []) + homography_poses(a, b, threshold)
    if not poses:
        return []
    wanted = np.arange(HYPOTHESES) < len(poses)
    poses = (poses + [poses[0]] * HYPOTHESES)[:HYPOTHESES]
    R, T = (jnp.asarray(np.stack(x), sigma.dtype) for x in zip(*poses, strict=True))
    first, second = (jnp.asarray(np.where(mask[:, None], u, 0), sigma.dtype) for u in (u1, u2))
    common = jnp.asarray(mask)
    rough = _refine(R, T, first, second, jnp.broadcast_to(common, (HYPOTHESES, len(mask))), wanted, common, sigma)
    # Hypotheses that have become the same are refined again as one; those that explain much less than the best are not.
    wanted = np.isin(np.arange(HYPOTHESES), _distinct(rough, worst=WORST))
    R = rough.pose.rotation.as_matrix()
    fine = _refine(R, rough.pose.translation, first, second, rough.inside, wanted, common, sigma)
    fine = jax.tree.map(np.asarray, fine)  # taken apart by NumPy: in JAX each index would be a program of its own
    return [
        Hypothesis(
            jax.tree.map(lambda x, k=k: jnp.asarray(x[k]), fine.pose),
            float(fine.cost[k]),
            fine.inside[k],
            float(np.rad2deg(fine.parallax[k])),
        )
        for k in _distinct(fine)
    ]


def _distinct(refined: _Refined, worst: float = np.inf) -> list[int]:
    """Which hypotheses differ, the cheapest first; none that costs more than `worst` times the best."""
    cost, poses = np.asarray(refined.cost), jax.tree.map(np.asarray, refined.pose)
    each = [jax.tree.map(lambda x, k=k: x[k], poses) for k in range(len(cost))]
    order = np.argsort(cost)  # NaN comes last
    dearest = worst * max(cost[order[0]], 1.0)
    found: list[int] = []
    for k in order:
        affordable = np.isfinite(cost[k]) and cost[k] <= dearest
        if affordable and all(_apart(each[k], each[other]) for other in found):
            found.append(int(k))
    return found


def _apart(a: two_view.TwoView, b: two_view.TwoView) -> bool:
    turn = np.linalg.norm((a.rotation @ b.rotation.inverse()).log())
    return bool(turn > SAME_TURN or np.linalg.norm(a.translation - b.translation) > SAME_DIRECTION)
