"""Trajectories, and how far one is from another (`T_world_camera` throughout: poses camera to world)."""

import math
import warnings
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int

from jaxtri.checks import number
from jaxtri.errors import TrajectoryError, TrajectoryWarning

# Largest departure of R R' from the identity: wide, since files carry few digits; it is for matrices of another kind.
RIGID = 1e-3
MATCHES = 3  # frames that two trajectories must have in common: two points leave a rotation open


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera poses over time, on the host.

    Raises `TrajectoryError` naming the first entry that cannot be used.

    Attributes:
        times: (t,) float64, seconds, strictly increasing.
        T_world_camera: (t, 4, 4) float64, camera to world, translation in scene units.
        covariance: (t, 6, 6) float64 of the error of each pose, or None: of the camera centre in world axes and scene
            units first, then of the rotation vector dtheta in camera axes and radians, with R_estimate = R_true
            exp(dtheta).
        status: (t,) int, codes of whoever made the trajectory, or None; `jaxtri.Status` for those of a run.
        frames: Number of frames where `times` are their numbers from 0 and no seconds, as of KITTI's files; None where
            they are seconds.
    """

    # The shapes are checked below, with a message of our own.
    times: np.ndarray
    T_world_camera: np.ndarray
    covariance: np.ndarray | None = None
    status: np.ndarray | None = None
    frames: int | None = None

    def __post_init__(self):
        shapes = {"times": (), "T_world_camera": (4, 4), "covariance": (6, 6), "status": ()}
        t = np.size(self.times)
        if t == 0:
            raise TrajectoryError("a trajectory needs at least one pose, and times is empty")
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            value = np.asarray(value, np.int64 if name == "status" else np.float64)
            if value.shape != (t, *shape):
                raise TrajectoryError(f"{name} has shape {value.shape}; with {t} times it must be {(t, *shape)}")
            bad = np.flatnonzero(~np.isfinite(value.reshape(t, -1)).all(-1))
            if len(bad):
                raise TrajectoryError(f"{name}[{bad[0]}] is not finite; leave out the poses that are unknown")
            object.__setattr__(self, name, value)
        late = np.flatnonzero(np.diff(self.times) <= 0)
        if len(late):
            i = late[0] + 1
            raise TrajectoryError(
                f"times[{i}] = {self.times[i]} does not come after times[{i - 1}] = {self.times[i - 1]}"
            )
        if self.frames is not None and not set(self.times.tolist()) <= set(range(self.frames)):
            raise TrajectoryError(f"with {self.frames} frames times must be whole numbers from 0 to {self.frames - 1}")
        R = self.rotations
        rigid = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max((1, 2)) < RIGID
        rigid &= (np.linalg.det(R) > 0) & (np.abs(self.T_world_camera[:, 3] - [0, 0, 0, 1]).max(-1) < 1e-9)
        if not rigid.all():
            raise TrajectoryError(f"T_world_camera[{np.argmin(rigid)}] is no rigid motion [R p; 0 0 0 1]")

    def __len__(self):
        return len(self.times)

    @property
    def positions(self) -> Float64[np.ndarray, "t 3"]:
        """Camera centres in the world."""
        return self.T_world_camera[:, :3, 3]

    @property
    def rotations(self) -> Float64[np.ndarray, "t 3 3"]:
        """Rotations from camera axes to world axes."""
        return self.T_world_camera[:, :3, :3]

    @property
    def path_length(self) -> float:
        """Length of the polyline through the camera centres."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=-1).sum())


class Similarity(eqx.Module):
    """A similarity transform x -> scale rotation x + translation.

    Attributes:
        scale: Units of the target in one unit of the source.
        rotation: (3, 3) matrix.
        translation: (3,) in units of the target.
    """

    scale: Float[Array, ""] = eqx.field(converter=number)
    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]

    def __call__(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Transform points."""
        return self.scale * points @ self.rotation.T + self.translation

    def transform_poses(self, T_world_camera: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 4 4"]:
        """Move the cameras: their centres as points, their axes by the rotation alone."""
        moved = T_world_camera.at[..., :3, :3].set(self.rotation @ T_world_camera[..., :3, :3])
        return moved.at[..., :3, 3].set(self(T_world_camera[..., :3, 3]))


def align(
    source: Float[Array, "t 3"],
    target: Float[Array, "t 3"],
    *,
    with_scale: bool = True,
    mask: Bool[Array, " t"] | None = None,
) -> Similarity:
    """The similarity (or rigid motion) that takes `source` closest to `target` in least squares.

    A rotation that the points leave open (all on a line, or all the same) is chosen arbitrarily, and
    nothing is differentiated along it; the scale of a static source is 1. Umeyama 1991, eqs. 40-42.
    """
    weights = _weights(source, mask)
    source, target = _kept(source, mask), _kept(target, mask)
    mean_source, mean_target = weights @ source, weights @ target
    a, b = source - mean_source, target - mean_target
    covariance = jnp.einsum("t,ti,tj->ij", weights, b, a)
    R = _closest_rotation(covariance)
    scale = jnp.ones((), source.dtype)
    if with_scale:
        variance = weights @ (a * a).sum(-1)
        # A camera whose variance is below the rounding of its coordinates stands still.
        static = variance <= (8 * jnp.finfo(source.dtype).eps * jnp.abs(source).max()) ** 2
        scale = jnp.where(static, 1, (R * covariance).sum() / jnp.where(static, 1, variance))
    return Similarity(scale, R, mean_target - scale * R @ mean_source)


def absolute_error(
    estimate: Float[Array, "t 3"],
    reference: Float[Array, "t 3"],
    *,
    with_scale: bool = True,
    mask: Bool[Array, " t"] | None = None,
) -> Float[Array, " t"]:
    """Distance of each camera centre from the reference after alignment (ATE), in units of the reference.

    Masked frames take no part and have an error of zero. Sturm et al. 2012, section V.
    """
    alignment = align(estimate, reference, with_scale=with_scale, mask=mask)
    return _norm(_kept(alignment(_kept(estimate, mask)) - _kept(reference, mask), mask))


def ate_rmse(
    estimate: Float[Array, "t 3"],
    reference: Float[Array, "t 3"],
    *,
    with_scale: bool = True,
    mask: Bool[Array, " t"] | None = None,
) -> Float[Array, ""]:
    """Root mean square of `absolute_error` over the frames that are not masked."""
    errors = absolute_error(estimate, reference, with_scale=with_scale, mask=mask)
    return _norm(jnp.sqrt(_weights(estimate, mask)) * errors)


def relative_errors(
    estimate: Float[Array, "t 4 4"], reference: Float[Array, "t 4 4"], delta: int = 1
) -> tuple[Float[Array, " t-{delta}"], Float[Array, " t-{delta}"]]:
    """Translation (scene units) and rotation (radians) of the error of the motion over `delta` frames (RPE).

    The estimate must be in the reference's scale already. Sturm et al. 2012, section V, eq. 1.
    """

    def motion(T):
        R = T[:-delta, :3, :3]
        step = T[delta:, :3, 3] - T[:-delta, :3, 3]
        return R.mT @ T[delta:, :3, :3], (R.mT @ step[..., None])[..., 0]

    R_estimate, t_estimate = motion(estimate)
    R_reference, t_reference = motion(reference)
    return _norm(t_estimate - t_reference), angle(R_reference.mT @ R_estimate)


def rotation_errors(
    estimate: Float[Array, "t 3 3"],
    reference: Float[Array, "t 3 3"],
    rotation: Float[Array, "3 3"] | None = None,
) -> Float[Array, " t"]:
    """Angle (radians) between the orientations of each frame, after turning the estimate's world.

    The world is turned by `rotation` (say, that of `align`); by default by the constant rotation that is best for the
    orientations themselves in the chordal sense. Hartley et al. 2013, section 5.3.
    """
    if rotation is None:
        rotation = _closest_rotation(jnp.einsum("tij,tkj->ik", reference, estimate))
    return angle(reference.mT @ rotation @ estimate)


def nees(errors: Float[Array, "*batch d"], covariance: Float[Array, "*batch d d"]) -> Float[Array, "*batch"]:
    """Normalised estimation error squared e' P^-1 e, whose mean is d for a consistent filter.

    NaN where a covariance is not positive definite. Bar-Shalom et al. 2001, eq. 5.4.2-2.
    """
    L = jnp.linalg.cholesky(covariance, symmetrize_input=False)
    whitened = jax.lax.linalg.triangular_solve(L, errors[..., None], left_side=True, lower=True)
    return (whitened[..., 0] ** 2).sum(-1)


@dataclass(frozen=True)
class Evaluation:
    """How far an estimate is from a reference, after one alignment of the whole; see `evaluate`.

    Lengths are in units of the reference. A percentage of a zero length is inf, or 0 for a zero error.

    Attributes:
        matched: Frames of the estimate that have a frame of the reference.
        coverage: Share of the reference's frames that are matched.
        scale: Reference units in one unit of the estimate.
        ate_rmse: Root mean square of the distances between the camera centres.
        ate_percent: The same, in per cent of the reference's path through the matched frames.
        rpe_translation: Root mean square error of the motion from each matched frame to the next, the estimate scaled
            as a whole.
        rpe_translation_percent: The same, in per cent of the reference's mean step.
        rpe_rotation_deg: Root mean square error of the rotation from each matched frame to the next, degrees.
        rotation_rmse_deg: Root mean square error of the orientations, after the best constant rotation of the world,
            degrees.
    """

    matched: int
    coverage: float
    scale: float
    ate_rmse: float
    ate_percent: float
    rpe_translation: float
    rpe_translation_percent: float
    rpe_rotation_deg: float
    rotation_rmse_deg: float


def evaluate(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    with_scale: bool = True,
    max_time_difference: float = 0.02,
) -> Evaluation:
    """Compare two trajectories frame by frame, in JAX's default float.

    Frames are matched when each is the other's nearest in time, within `max_time_difference` seconds. Where one has
    no times (`Trajectory.frames`), frames of the same number are matched, and only if both have as many; where the
    other one has times, a `TrajectoryWarning` says so. Raises `TrajectoryError` where they are not comparable, or
    fewer than three frames match. Sturm et al. 2012, section V.
    """
    if estimate.frames is None and reference.frames is None:
        i, j = associate(estimate.times, reference.times, max_time_difference)
    else:
        i, j = _same_numbers(estimate, reference)
    if len(i) < MATCHES:
        spans = [f"{x.times[0]:.9g} to {x.times[-1]:.9g} s ({len(x)} frames)" for x in (estimate, reference)]
        raise TrajectoryError(
            f"only {len(i)} frames match within {max_time_difference} s and {MATCHES} are needed: the estimate spans "
            f"{spans[0]}, the reference {spans[1]}; check the clocks and units, or max_time_difference"
        )
    poses = _centred(estimate.T_world_camera[i]), _centred(reference.T_world_camera[j])
    scale, *errors = _compare(*poses, with_scale)
    ate, translation, rotation, orientation = (_rms(error) for error in errors)
    steps = np.linalg.norm(np.diff(reference.positions[j], axis=0), axis=-1)
    return Evaluation(
        matched=len(i),
        coverage=len(i) / len(reference),
        scale=float(scale),
        ate_rmse=ate,
        ate_percent=_percent(ate, steps.sum()),
        rpe_translation=translation,
        rpe_translation_percent=_percent(translation, steps.mean()),
        rpe_rotation_deg=math.degrees(rotation),
        rotation_rmse_deg=math.degrees(orientation),
    )


def _same_numbers(estimate: Trajectory, reference: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the frames of one number, where at least one trajectory has no times."""
    lengths = [len(x) if x.frames is None else x.frames for x in (estimate, reference)]
    counts = f"the estimate has {lengths[0]} frames and the reference {lengths[1]}"
    both = estimate.frames is not None and reference.frames is not None
    which = (
        "neither has times" if both else f"the {'reference' if estimate.frames is None else 'estimate'} has no times"
    )
    if lengths[0] != lengths[1]:
        remedy = (
            "give the shorter one with times (TUM format), and --times FILE for the other"
            if both
            else "give the time of every line of the KITTI file (--times FILE, or times.txt beside it)"
        )
        raise TrajectoryError(f"{which} (KITTI format), and {counts}: which belong together is not known; {remedy}")
    if not both:
        warnings.warn(f"{which} (KITTI format): line by line, as {counts}", TrajectoryWarning, stacklevel=3)
    numbers = [np.arange(len(x)) if x.frames is None else x.times.astype(int) for x in (estimate, reference)]
    return np.intersect1d(*numbers, assume_unique=True, return_indices=True)[1:]


def associate(
    times_a: Float[np.ndarray, " a"], times_b: Float[np.ndarray, " b"], max_difference: float
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Indices of the pairs of times that are each other's nearest, at most `max_difference` apart.

    Both lists must increase. Host only.
    """

    def nearest(times, others):
        right = np.searchsorted(others, times).clip(1, max(len(others) - 1, 1))
        left_is_nearer = times - others[right - 1] <= others[np.minimum(right, len(others) - 1)] - times
        return np.where(left_is_nearer, right - 1, np.minimum(right, len(others) - 1))

    b = nearest(times_a, times_b)
    mutual = nearest(times_b, times_a)[b] == np.arange(len(times_a))
    a = np.flatnonzero(mutual & (np.abs(times_a - times_b[b]) <= max_difference))
    return a, b[a]


@partial(jax.jit, static_argnums=2)
def _compare(estimate: Float[Array, "t 4 4"], reference: Float[Array, "t 4 4"], with_scale: bool):
    alignment = align(estimate[:, :3, 3], reference[:, :3, 3], with_scale=with_scale)
    aligned = alignment.transform_poses(estimate)
    ate = _norm(aligned[:, :3, 3] - reference[:, :3, 3])
    orientation = rotation_errors(estimate[:, :3, :3], reference[:, :3, :3])
    return alignment.scale, ate, *relative_errors(aligned, reference), orientation


def _centred(T: Float64[np.ndarray, "t 4 4"]) -> Float[Array, "t 4 4"]:
    # No metric depends on the origin, and map coordinates of millions of metres are lost in float32.
    T = T.copy()
    T[:, :3, 3] -= T[:, :3, 3].mean(0)
    return jnp.asarray(T)


def _rms(errors: Float[Array, " t"]) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(errors, np.float64)))))


def _percent(error: float, length: float) -> float:
    if error == 0:
        return 0.0
    return 100 * error / float(length) if length > 0 else math.inf


def _weights(points: Float[Array, "t 3"], mask: Bool[Array, " t"] | None) -> Float[Array, " t"]:
    if mask is None:
        return jnp.full(len(points), 1 / max(len(points), 1), points.dtype)
    kept = mask.astype(points.dtype)
    return kept / jnp.maximum(kept.sum(), 1)


def _kept(values: Float[Array, "t *rest"], mask: Bool[Array, " t"] | None) -> Float[Array, "t *rest"]:
    if mask is None:
        return values
    return jnp.where(mask.reshape(-1, *[1] * (values.ndim - 1)), values, 0)


def _norm(x: Float[Array, "*batch d"]) -> Float[Array, "*batch"]:
    squared = (x * x).sum(-1)
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)


def _vee(R: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    return jnp.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)


def angle(R: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch"]:
    """By how much rotation matrices turn, radians."""
    # Not arccos of the trace, which has half the digits, and no derivative, at small angles.
    return jnp.arctan2(_norm(_vee(R)), jnp.trace(R, axis1=-2, axis2=-1) - 1)


def _closest_rotation(M: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The rotation R of largest tr(R' M), with first derivatives also where singular values coincide."""
    # The SVD's own derivatives divide by differences of singular values, of which R is free. Instead, a
    # Newton step of tr(R' M) over R exp(w) from the solution: w is zero there, its derivatives are right.
    U, d, Vt = jnp.linalg.svd(jax.lax.stop_gradient(M))
    signs = jnp.ones(3, M.dtype).at[2].set(jnp.sign(jnp.linalg.det(U @ Vt)))  # no mirror images
    R = (U * signs) @ Vt
    d = d * signs
    curvature = d.sum() - d  # of the Hessian tr(R' M) I - R' M, whose axes are the rows of Vt
    open_axis = curvature <= 32 * jnp.finfo(M.dtype).eps * d[0]
    inverse = jnp.where(open_axis, 0, 1 / jnp.where(open_axis, 1, curvature))
    w = Vt.T @ (inverse * (Vt @ _vee(R.T @ M)))
    w = w - jax.lax.stop_gradient(w)  # the rounding of zero
    zero = jnp.zeros((), M.dtype)
    hat = jnp.stack([zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero]).reshape(3, 3)
    return R + R @ hat
