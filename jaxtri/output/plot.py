"""Pictures of a trajectory, as in figures 9, 11 and 13 of Yu et al. 2006, with what is known of its errors."""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SO3
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxtri.geometry.pose import euler_from_matrix
from jaxtri.trajectory import Trajectory

# Okabe & Ito's colours: told apart by everybody.
COLOURS = ("#0072B2", "#D55E00", "#009E73")
SHADES = {
    "initialising": "#BBBBBB",
    "coasting": "#F0E442",
    "restarted": "#CC79A7",
    "lost": "#666666",
    "uncertain": "#E69F00",
}
MARKERS = ("^", "o", "s")
NAMES = ("x (right)", "y (down)", "z (ahead)")
GAP = 3.5  # median steps from which a line is broken: more than two frames are missing, however uneven the clock
RUN = 1.5  # median steps that may lie between two frames of one shaded span
BULK = (4, 96)  # percentiles of the points that must be in the picture
ROOM = 0.2  # of their extent, about them


def yaw_pitch_roll(
    R: Float[np.ndarray, "t 3 3"], origin: Float[np.ndarray, "3 3"] | None = None
) -> Float[np.ndarray, "t 3"]:
    """The paper's angles of rotations, degrees, without jumps; relative to `origin`, or else to the first."""
    relative = jnp.asarray((R[0] if origin is None else origin).T @ R)
    return np.rad2deg(np.unwrap(np.asarray(jax.vmap(euler_from_matrix)(relative), np.float64), axis=0))


@jax.jit
@jax.vmap
def _angle_variance(relative: Float[Array, "3 3"], covariance: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Variances of yaw, pitch, roll from the covariance of the rotation vector in camera axes, to first order."""

    def angles(dtheta):
        return euler_from_matrix(relative @ SO3.exp(dtheta).as_matrix())

    J = jax.jacfwd(angles)(jnp.zeros(3, relative.dtype))
    return jnp.diagonal(J @ covariance @ J.T)


def plot_trajectory(
    trajectory: Trajectory,
    *,
    reference: Trajectory | None = None,
    points: Float[np.ndarray, "n 3"] | None = None,
    names: Mapping[int, str] | None = None,
    units: str = "scene units",
    title: str = "",
) -> Figure:
    """The path from above and from the side, and translation and rotation over time with 2-sigma bands.

    `reference` must be in the frame and scale of the trajectory already. `names` of the status codes: frames
    of any but "tracking" are shaded. Lines are broken where more than two frames have no pose.
    """
    figure = Figure(figsize=(11, 7.5), layout="constrained")
    above, side, move, turn = figure.subplots(2, 2).ravel()
    p = trajectory.positions
    seconds = trajectory.times - trajectory.times[0]
    k = 0 if np.ptp(p[:, 0]) > np.ptp(p[:, 2]) else 2  # from the side that shows more of the path
    for axes, plane, name in ((above, (0, 2), "path from above"), (side, (k, 1), "path from the side")):
        _path(axes, plane, trajectory, reference, points)
        across, up = (f"{NAMES[i]} [{units}]" for i in plane)
        axes.set(xlabel=across, ylabel=up, title=name)
    side.invert_yaxis()

    sd_p, sd_r = _deviations(trajectory)
    _curves(move, seconds, p - p[0], sd_p, ("$t_x$", "$t_y$", "$t_z$"))
    _curves(turn, seconds, yaw_pitch_roll(trajectory.rotations), sd_r, ("yaw", "pitch", "roll"))
    if reference is not None:
        times = reference.times - trajectory.times[0]
        truths = (reference.positions - p[0], yaw_pitch_roll(reference.rotations, trajectory.rotations[0]))
        for axes, truth in zip((move, turn), truths, strict=True):
            lines = axes.plot(_broken(times, times), _broken(times, truth), "k--", lw=0.9)
            lines[0].set_label("truth")
    move.set(xlabel="time [s]", ylabel=f"translation [{units}]", title="translation, with 2 sigma")
    turn.set(xlabel="time [s]", ylabel="rotation [degrees]", title="rotation, with 2 sigma")
    if trajectory.status is not None and names is not None:
        for axes in (move, turn):
            _shade(axes, seconds, trajectory.status, names)
    for axes in (move, turn):
        axes.legend(loc="best", fontsize=8)
    for axes in (above, side, move, turn):
        axes.grid(alpha=0.25)
    if title:
        figure.suptitle(title)
    return figure


def _path(
    axes: Axes,
    plane: tuple[int, int],
    trajectory: Trajectory,
    reference: Trajectory | None,
    points: np.ndarray | None,
) -> None:
    """The path, the truth and the points, seen along the axis that `plane` leaves out."""
    p = trajectory.positions[:, plane]
    if points is not None and len(points):
        _cloud(axes, points[:, plane])
    if reference is not None:
        axes.plot(*_broken(reference.times, reference.positions[:, plane]).T, "k--", lw=1, label="truth")
    axes.plot(*_broken(trajectory.times, p).T, color=COLOURS[0], lw=1.8, label="estimate")
    axes.plot(*p[0], "o", color=COLOURS[2], label="start")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="best", fontsize=8)


def _deviations(trajectory: Trajectory) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Standard deviations (t, 3) of the positions, and of yaw, pitch and roll in degrees; None where unknown."""
    C, R = trajectory.covariance, trajectory.rotations
    if C is None:
        return None, None
    positions = np.sqrt(np.maximum(np.diagonal(C[:, :3, :3], axis1=1, axis2=2), 0))
    variance = np.asarray(_angle_variance(jnp.asarray(R[0].T @ R), jnp.asarray(C[:, 3:, 3:])), np.float64)
    return positions, np.rad2deg(np.sqrt(np.maximum(variance, 0)))


def _broken(times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The values with a NaN put into every gap of more than two frames: matplotlib breaks its lines there."""
    steps = np.diff(times)
    gaps = np.flatnonzero(steps > GAP * np.median(steps)) + 1 if len(steps) else []
    return np.insert(np.asarray(values, np.float64), gaps, np.nan, axis=0)


def _curves(axes: Axes, seconds: np.ndarray, values: np.ndarray, sd: np.ndarray | None, labels: Sequence[str]) -> None:
    every, x = max(len(seconds) // 12, 1), _broken(seconds, seconds)
    for k, label in enumerate(labels):
        y, colour = _broken(seconds, values[:, k]), COLOURS[k]
        axes.plot(x, y, color=colour, lw=1.5, marker=MARKERS[k], markevery=every, ms=5, label=label)
        if sd is not None:
            half = 2 * _broken(seconds, sd[:, k])
            axes.fill_between(x, y - half, y + half, color=colour, alpha=0.22, lw=0)


def _shade(axes: Axes, seconds: np.ndarray, status: np.ndarray, names: Mapping[int, str]) -> None:
    half = np.median(np.diff(seconds)) / 2 if len(seconds) > 1 else 0.5
    # A span for each run of one status without a gap.
    breaks = (np.diff(status) != 0) | (np.diff(seconds) > RUN * 2 * half)
    shown = set()
    for run in np.split(np.arange(len(seconds)), np.flatnonzero(breaks) + 1):
        name = names.get(int(status[run[0]]), "")
        if name in SHADES:
            label = None if name in shown else name
            shown.add(name)
            first, last = float(seconds[run[0]] - half), float(seconds[run[-1]] + half)
            axes.axvspan(first, last, color=SHADES[name], alpha=0.4, lw=0, label=label)


def _cloud(axes: Axes, points: np.ndarray) -> None:
    """The points, but those far from the bulk: one wild depth must not shrink the path to a dot."""
    low, high = np.percentile(points, BULK, axis=0)
    margin = ROOM * (high - low) + 1e-9
    good = ((points > low - margin) & (points < high + margin)).all(axis=1)
    axes.plot(*points[good].T, ".", color="#999999", ms=1.5, alpha=0.5, label="points", zorder=0)
