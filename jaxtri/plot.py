"""Pictures of a trajectory, as in figures 9, 11 and 13 of Yu et al. 2006, with what is known of its errors."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from jaxtri.geometry.pose import euler_from_matrix
from jaxtri.trajectory import Trajectory

# Okabe & Ito's colours: told apart by everybody.
COLOURS = ("#0072B2", "#D55E00", "#009E73")
SHADES = {"initialising": "#BBBBBB", "coasting": "#F0E442", "restarted": "#CC79A7", "lost": "#666666"}
MARKERS = ("^", "o", "s")


def yaw_pitch_roll(R: Float[np.ndarray, "t 3 3"]) -> Float[np.ndarray, "t 3"]:
    """The paper's angles of rotations, degrees, without jumps; relative to the first."""
    relative = jnp.asarray(np.swapaxes(R[:1], 1, 2) @ R)
    return np.rad2deg(np.unwrap(np.asarray(jax.vmap(euler_from_matrix)(relative), np.float64), axis=0))


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
    of any but "tracking" are shaded.
    """
    figure = Figure(figsize=(11, 7.5), layout="constrained")
    above, side, move, turn = figure.subplots(2, 2).ravel()
    p = trajectory.positions
    seconds = trajectory.times - trajectory.times[0]
    # From the side that shows more of the path.
    k = 0 if np.ptp(p[:, 0]) > np.ptp(p[:, 2]) else 2
    for axes, (i, j), labels, name in (
        (above, (0, 2), ("x (right)", "z (ahead)"), "path from above"),
        (side, (k, 1), ("x (right)" if k == 0 else "z (ahead)", "y (down)"), "path from the side"),
    ):
        if points is not None and len(points):
            _cloud(axes, points[:, [i, j]], p[:, [i, j]])
        if reference is not None:
            axes.plot(*reference.positions[:, [i, j]].T, color="black", lw=1, ls="--", label="truth")
        axes.plot(*p[:, [i, j]].T, color=COLOURS[0], lw=1.8, label="estimate")
        axes.plot(*p[0, [i, j]], "o", color=COLOURS[2], label="start")
        axes.set(xlabel=f"{labels[0]} [{units}]", ylabel=f"{labels[1]} [{units}]", title=name)
        axes.set_aspect("equal", adjustable="datalim")
        axes.legend(loc="best", fontsize=8)
    side.invert_yaxis()

    angles = yaw_pitch_roll(trajectory.rotations)
    sd_p = sd_r = None
    if trajectory.covariance is not None:
        variance = np.diagonal(trajectory.covariance, axis1=1, axis2=2)
        sd_p = np.sqrt(np.maximum(variance[:, :3], 0))
        # Rotation vectors (x, y, z) of small angles are pitch, yaw, roll.
        sd_r = np.rad2deg(np.sqrt(np.maximum(variance[:, [4, 3, 5]], 0)))
    truth_p = truth_r = None
    if reference is not None:
        truth_p, truth_r = reference.positions, yaw_pitch_roll(reference.rotations)
    _curves(move, seconds, p - p[0], sd_p, ("$t_x$", "$t_y$", "$t_z$"), reference, None if truth_p is None else truth_p - truth_p[0])
    _curves(turn, seconds, angles, sd_r, ("yaw", "pitch", "roll"), reference, truth_r)
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


def _curves(axes, seconds, values, sd, labels, reference, truth) -> None:
    for k, label in enumerate(labels):
        every = max(len(seconds) // 12, 1)
        axes.plot(seconds, values[:, k], color=COLOURS[k], lw=1.5, marker=MARKERS[k], markevery=every, ms=5, label=label)
        if sd is not None:
            low, high = values[:, k] - 2 * sd[:, k], values[:, k] + 2 * sd[:, k]
            axes.fill_between(seconds, low, high, color=COLOURS[k], alpha=0.22, lw=0)
        if truth is not None:
            times = reference.times - reference.times[0]
            axes.plot(times, truth[:, k], color="black", lw=0.9, ls="--", label="truth" if k == 0 else None)


def _shade(axes, seconds, status, names) -> None:
    shown = set()
    half = np.median(np.diff(seconds)) / 2 if len(seconds) > 1 else 0.5
    for t, code in zip(seconds, status, strict=True):
        name = names.get(int(code), "")
        if name in SHADES:
            label = None if name in shown else name
            shown.add(name)
            axes.axvspan(t - half, t + half, color=SHADES[name], alpha=0.4, lw=0, label=label)


def _cloud(axes, points, path) -> None:
    """The points, but those far from the bulk: one wild depth must not shrink the path to a dot."""
    low, high = np.percentile(points, [4, 96], axis=0)
    margin = 0.2 * (high - low) + 1e-9
    good = ((points > low - margin) & (points < high + margin)).all(axis=1)
    axes.plot(*points[good].T, ".", color="#999999", ms=1.5, alpha=0.5, label="points", zorder=0)

