import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SO3

from jaxtri.geometry.pose import euler_from_matrix
from jaxtri.output.plot import plot_trajectory
from jaxtri.trajectory import Trajectory

NAMES = {0: "initialising", 1: "tracking", 2: "coasting"}


@pytest.fixture
def trajectory():
    """Twenty frames a tenth of a second apart, frames 8 to 12 without a pose, turning by a radian in all."""
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (20, 1, 1))
    vectors = np.linspace(0, 1, 20)[:, None] * [0.3, 0.9, -0.3] + [0.5, 0, 0]
    T[:, :3, :3] = jax.vmap(lambda v: SO3.exp(v).as_matrix())(jnp.asarray(vectors))
    T[:, :3, 3] = rng.normal(size=(20, 3)).cumsum(axis=0)
    A = rng.normal(size=(20, 6, 6)) * 0.02
    status = np.array([0] * 3 + [1] * 13 + [2] * 4)
    keep = np.r_[:8, 13:20]
    return Trajectory(5 + 0.1 * np.arange(20)[keep], T[keep], (A @ A.swapaxes(1, 2))[keep], status[keep])


def lines(axes):
    return {line.get_label(): line for line in axes.get_lines()}


def bands(axes):
    """Lower and upper edge of each band, over the frames, keyed by the time from the start in tenths."""
    found = []
    for band in axes.collections:
        edges = {}
        for path in band.get_paths():
            for x, y in path.vertices:
                edges.setdefault(round(10 * x), []).append(y)
        found.append(np.array([(min(edges[k]), max(edges[k])) for k in sorted(edges)]))
    return found


def test_bands_are_two_sigma_of_the_covariance(trajectory):
    _, _, move, turn = plot_trajectory(trajectory).axes
    C = trajectory.covariance
    for k, edges in enumerate(bands(move)):
        half = 2 * np.sqrt(C[:, k, k])
        middle = (trajectory.positions - trajectory.positions[0])[:, k]
        np.testing.assert_allclose(edges, np.stack([middle - half, middle + half], -1), atol=1e-9)

    # The slow twin: angles of sampled rotations.
    R = trajectory.rotations
    samples = jnp.asarray(np.random.default_rng(1).normal(size=(2000, 3)))

    def angles(R_now, C_now):
        noise = samples @ jnp.linalg.cholesky(C_now).T * 0.1  # small enough to be linear
        return jax.vmap(lambda d: euler_from_matrix(jnp.asarray(R[0].T) @ R_now @ SO3.exp(d).as_matrix()))(noise)

    sampled = jax.vmap(angles)(jnp.asarray(R), jnp.asarray(C[:, 3:, 3:]))
    middle, sd = np.degrees(sampled.mean(axis=1)), np.degrees(sampled.std(axis=1)) / 0.1
    for k, edges in enumerate(bands(turn)):
        np.testing.assert_allclose(edges.mean(axis=1), middle[:, k], atol=0.05)
        np.testing.assert_allclose(np.ptp(edges, axis=1), 4 * sd[:, k], rtol=0.08)


def test_lines_break_where_poses_are_missing(trajectory):
    above, side, move, turn = plot_trajectory(trajectory).axes
    for axes, label in ((above, "estimate"), (side, "estimate"), (move, "$t_x$"), (turn, "yaw")):
        x, y = lines(axes)[label].get_data()
        assert np.flatnonzero(np.isnan(x)).tolist() == np.flatnonzero(np.isnan(y)).tolist() == [8]
    np.testing.assert_allclose(lines(move)["$t_z$"].get_xdata()[[0, 7, 9, -1]], [0, 0.7, 1.3, 1.9])


def test_truth_is_drawn_relative_to_the_first_estimate(trajectory):
    # The truth begins earlier: here it is the trajectory, which as an estimate starts at its third pose.
    part = Trajectory(trajectory.times[2:], trajectory.T_world_camera[2:])
    for axes, labels in zip(plot_trajectory(part, reference=trajectory).axes[2:], (["$t_x$"], ["yaw"]), strict=True):
        truth, estimate = lines(axes)["truth"].get_xydata(), lines(axes)[labels[0]].get_xydata()
        np.testing.assert_allclose(truth[2:], estimate, atol=1e-9)


def test_a_full_figure_is_saved(trajectory, tmp_path):
    points = np.random.default_rng(0).normal(size=(50, 3))
    points[0] = 1e6  # a wild depth
    figure = plot_trajectory(trajectory, reference=trajectory, points=points, names=NAMES, units="m", title="a test")
    figure.savefig(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 20_000
    above, side, move, turn = figure.axes
    assert np.abs(above.get_xlim()).max() < 100
    assert {"initialising", "coasting"} <= {t.get_text() for t in turn.get_legend().get_texts()}
    assert "tracking" not in {t.get_text() for t in move.get_legend().get_texts()}
    spans = {patch.get_label(): patch.get_extents() for patch in move.patches}
    ends = {name: move.transData.inverted().transform(span)[:, 0] for name, span in spans.items()}
    np.testing.assert_allclose(ends["initialising"], [-0.05, 0.25], atol=1e-6)
    np.testing.assert_allclose(ends["coasting"], [1.55, 1.95], atol=1e-6)
    assert side.yaxis_inverted()


def test_one_pose_is_enough():
    figure = plot_trajectory(Trajectory(np.array([3.0]), np.eye(4)[None], status=np.array([0])), names=NAMES)
    figure.draw_without_rendering()
