import warnings

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxtri.errors import TrajectoryError, TrajectoryWarning
from jaxtri.trajectory import (
    Trajectory,
    absolute_error,
    align,
    associate,
    ate_rmse,
    evaluate,
    nees,
    relative_errors,
    rotation_errors,
)

jit_align = jax.jit(align, static_argnames="with_scale")
jit_rotation_errors = jax.jit(rotation_errors)


def poses(noise=0.0, t=12):
    """A smooth walk, and the same with noise on positions and orientations."""
    rng = np.random.default_rng(1)
    walk = np.cumsum(0.1 * rng.normal(size=(t, 6)) + [0.3, 0, 0.2, 0, 0.02, 0], 0)
    errors = noise * rng.normal(size=(t, 6))
    T = np.eye(4)[None].repeat(t, 0)
    T[:, :3, 3] = walk[:, :3]
    T[:, :3, :3] = Rotation.from_rotvec(walk[:, 3:]).as_matrix()
    noisy = T.copy()
    noisy[:, :3, 3] += errors[:, :3]
    noisy[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(errors[:, 3:]).as_matrix()
    return T, noisy


def moved(T, scale=2.5):
    """Another gauge: a similarity applied to the world of camera-to-world poses."""
    R = Rotation.from_rotvec([0.4, -1.2, 0.7]).as_matrix()
    out = T.copy()
    out[:, :3, 3] = scale * T[:, :3, 3] @ R.T + [5.0, -3.0, 100.0]
    out[:, :3, :3] = R @ T[:, :3, :3]
    return out


def trajectory(T, times=None):
    return Trajectory(np.arange(len(T)) * 0.1 if times is None else times, T)


@pytest.mark.parametrize("with_scale", [True, False])
def test_metrics_agree_with_evo(with_scale):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # evo's imports warn
        from evo.core.metrics import APE, RPE, PoseRelation, Unit
        from evo.core.trajectory import PoseTrajectory3D

    reference, noisy = poses(noise=0.05)
    estimate = moved(noisy, 2.5 if with_scale else 1.0)
    result = evaluate(trajectory(estimate), trajectory(reference), with_scale=with_scale)

    times = np.arange(len(reference)) * 0.1
    evo_reference = PoseTrajectory3D(poses_se3=list(reference), timestamps=times)
    evo_estimate = PoseTrajectory3D(poses_se3=list(estimate), timestamps=times)
    R, t, scale = evo_estimate.align(evo_reference, correct_scale=with_scale)

    def metric(kind, relation, *arguments):
        it = kind(relation, *arguments)
        it.process_data((evo_reference, evo_estimate))
        return it.error, it.get_all_statistics()["rmse"]

    ate, ate_expected = metric(APE, PoseRelation.translation_part)
    a, b = jnp.asarray(estimate), jnp.asarray(reference)
    alignment = jit_align(a[:, :3, 3], b[:, :3, 3], with_scale=with_scale)
    distances = np.linalg.norm(alignment.transform_poses(a)[:, :3, 3] - reference[:, :3, 3], axis=-1)
    angles = jit_rotation_errors(a[:, :3, :3], b[:, :3, :3], alignment.rotation)
    np.testing.assert_allclose(distances, ate, atol=1e-12)
    np.testing.assert_allclose(alignment.rotation, R, atol=1e-12)
    np.testing.assert_allclose(alignment.translation, t, atol=1e-10)
    np.testing.assert_allclose(angles, metric(APE, PoseRelation.rotation_angle_rad)[0], atol=1e-10)
    every = (1, Unit.frames, 0.1, True)
    np.testing.assert_allclose(
        [result.scale, result.ate_rmse, result.rpe_translation, result.rpe_rotation_deg],
        [
            scale,
            ate_expected,
            metric(RPE, PoseRelation.translation_part, *every)[1],
            metric(RPE, PoseRelation.rotation_angle_deg, *every)[1],
        ],
        rtol=1e-10,
    )
    length = evo_reference.path_length
    np.testing.assert_allclose(trajectory(reference).path_length, length)
    np.testing.assert_allclose(result.ate_percent, 100 * ate_expected / length, rtol=1e-10)
    mean_step = length / (len(reference) - 1)
    np.testing.assert_allclose(result.rpe_translation_percent, 100 * result.rpe_translation / mean_step, rtol=1e-10)
    assert (result.matched, result.coverage) == (12, 1.0)


def test_no_metric_depends_on_the_gauge_of_the_estimate():
    reference, noisy = poses(noise=0.05)
    here = evaluate(trajectory(noisy), trajectory(reference))
    there = evaluate(trajectory(moved(noisy)), trajectory(reference))
    for name, value in vars(here).items():
        if name != "scale":
            np.testing.assert_allclose(getattr(there, name), value, rtol=1e-9, err_msg=name)
    # and none is left when the estimate is the reference in another gauge
    exact = evaluate(trajectory(moved(reference)), trajectory(reference))
    np.testing.assert_allclose(exact.scale, 1 / 2.5)
    assert max(exact.ate_rmse, exact.rpe_translation, exact.rpe_rotation_deg, exact.rotation_rmse_deg) < 1e-6


def test_alignment_beats_its_neighbours_and_never_mirrors():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(12, 3))
    mirrored = source * [1, 1, -1] @ Rotation.from_rotvec([1, 1, 1]).as_matrix().T
    best = jax.tree.map(np.asarray, jit_align(jnp.asarray(source), jnp.asarray(mirrored)))
    np.testing.assert_allclose(np.linalg.det(best.rotation), 1)

    def cost(change):
        rotation = best.rotation @ Rotation.from_rotvec(change[:3]).as_matrix()
        points = best.scale * (1 + change[6]) * source @ rotation.T + best.translation + change[3:6]
        return ((points - mirrored) ** 2).sum()

    assert all(cost(0.01 * rng.normal(size=7)) > cost(np.zeros(7)) for _ in range(50))


def test_orientation_alignment_agrees_with_scipy():
    reference, noisy = poses(noise=0.2)
    estimate, reference = moved(noisy)[:, :3, :3], reference[:, :3, :3]
    axes = [R.transpose(0, 2, 1).reshape(-1, 3) for R in (reference, estimate)]
    rotation = Rotation.align_vectors(*axes)[0].as_matrix()
    expected = Rotation.from_matrix(reference.transpose(0, 2, 1) @ rotation @ estimate).magnitude()
    ours = jit_rotation_errors(jnp.asarray(estimate), jnp.asarray(reference))
    np.testing.assert_allclose(ours, expected, atol=1e-10)


def outputs(source, target):
    """Everything that is differentiated, of two trajectories of poses (t, 4, 4)."""
    a, b = source[:, :3, 3], target[:, :3, 3]
    return {
        "alignment": jax.flatten_util.ravel_pytree(align(a, b))[0],
        "absolute": absolute_error(a, b, with_scale=False),
        "relative": jnp.concatenate(relative_errors(source, target, 2)),
        "rotation": rotation_errors(source[:, :3, :3], target[:, :3, :3]),
    }


@jax.jit
def derivatives(points, directions, weights):
    """Values, forward derivatives along `directions`, reverse derivatives of `weights`."""
    values, forward = jax.linearize(lambda points: outputs(*points), points)
    return values, forward(directions), jax.linear_transpose(forward, points)(weights)[0]


def test_derivatives_are_those_of_central_differences():
    target, noisy = poses(noise=0.1)
    at = np.stack([moved(noisy), target])
    rng = np.random.default_rng(0)
    weights = {name: rng.normal(size=x.shape) for name, x in jax.eval_shape(outputs, *at).items()}
    for d in rng.normal(size=(6, *at.shape)):
        _, exact, gradient = derivatives(at, d, weights)
        plus, minus = (derivatives(at + h * d, d, weights)[0] for h in (1e-6, -1e-6))
        for name in exact:
            numeric = (np.asarray(plus[name]) - np.asarray(minus[name])) / 2e-6
            np.testing.assert_allclose(exact[name], numeric, rtol=1e-6, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(
            np.vdot(gradient, d), sum(np.vdot(weights[name], exact[name]) for name in exact), rtol=1e-9
        )


@pytest.mark.parametrize("shape", ["same", "line", "static", "both static", "equal axes"])
def test_degenerate_trajectories_give_finite_values_and_gradients(shape):
    target, source = poses(noise=0.1)
    line = np.arange(12.0)[:, None] * [1.0, 2.0, -3.0] + 7.0
    tetrahedron = np.asarray([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]] * 3)
    source[:, :3, 3], target[:, :3, 3] = {
        "same": (target[:, :3, 3], target[:, :3, 3]),
        "line": (line, line + 5.0),
        "static": (line[:1] * 1.1, target[:, :3, 3]),
        "both static": (line[:1] * 1.1, line[1:2] / 3),
        "equal axes": (tetrahedron, tetrahedron),
    }[shape]
    if shape == "same":
        source = target
    at = np.stack([source, target])
    shapes = jax.eval_shape(outputs, *at)
    results = derivatives(at, np.cos(at), {name: np.ones(x.shape) for name, x in shapes.items()})
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(results))
    if shape != "static":
        np.testing.assert_allclose(results[0]["absolute"], 0, atol=1e-12)
    result = evaluate(trajectory(source), trajectory(target))
    assert not any(np.isnan(value) for value in vars(result).values())


def test_masked_frames_equal_absent_frames():
    reference, noisy = poses(noise=0.1, t=18)
    a, b = noisy[:, :3, 3], reference[:, :3, 3]
    kept = np.arange(18) % 3 != 1

    @jax.jit
    def masked(a, b, mask):
        return absolute_error(a, b, mask=mask), *jax.value_and_grad(ate_rmse)(a, b, mask=mask)

    broken = [np.where(kept[:, None], a, fill) for fill in (np.nan, 1e9)]
    results = [masked(jnp.asarray(x), jnp.asarray(b), jnp.asarray(kept)) for x in broken]
    a, b = a[kept], b[kept]
    alignment = jit_align(jnp.asarray(a), jnp.asarray(b))
    residuals = np.asarray(alignment(jnp.asarray(a))) - b
    rmse = np.sqrt((residuals**2).sum(-1).mean())
    # The alignment is the minimum, so that its own derivatives do not enter (the envelope theorem).
    gradient = float(alignment.scale) * residuals @ np.asarray(alignment.rotation) / (len(a) * rmse)
    for result in results:
        errors, rmse_masked, gradient_masked = (np.asarray(x) for x in result)
        np.testing.assert_allclose(errors[kept], np.linalg.norm(residuals, axis=-1), rtol=1e-9)
        np.testing.assert_allclose(rmse_masked, rmse)
        np.testing.assert_allclose(gradient_masked[kept], gradient, atol=1e-12)
        np.testing.assert_array_equal(gradient_masked[~kept], 0)


def test_nees_is_the_squared_mahalanobis_distance():
    rng = np.random.default_rng(0)
    A, e = rng.normal(size=(4, 3, 6, 6)), rng.normal(size=(4, 3, 6))
    P = A @ A.swapaxes(2, 3) + np.eye(6)
    expected = np.einsum("abi,abij,abj->ab", e, np.linalg.inv(P), e)
    np.testing.assert_allclose(nees(jnp.asarray(e), jnp.asarray(P)), expected, rtol=1e-10)


def test_everything_stays_float32():
    T = jax.ShapeDtypeStruct((5, 4, 4), jnp.float32)
    assert {leaf.dtype for leaf in jax.tree.leaves(jax.eval_shape(outputs, T, T))} == {jnp.dtype("float32")}
    e, P = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((6,), (6, 6)))
    assert jax.eval_shape(nees, e, P).dtype == jnp.float32


def test_association_is_one_to_one_and_agrees_with_brute_force():
    rng = np.random.default_rng(0)
    a, b = np.sort(rng.uniform(0, 10, 60)), np.sort(rng.uniform(2, 12, 45))
    distance = np.abs(a[:, None] - b)
    expected = [
        (i, j)
        for i in range(60)
        for j in range(45)
        if distance[i].argmin() == j and distance[:, j].argmin() == i and distance[i, j] <= 0.05
    ]
    i, j = associate(a, b, 0.05)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == expected
    np.testing.assert_array_equal(associate(a[:1], b[:1], 100.0), [[0], [0]])


def test_evaluate_on_part_of_the_reference():
    reference, noisy = poses(noise=0.05, t=24)
    times = np.arange(24) * 0.1
    part = Trajectory(times[6:18] + 0.004, noisy[6:18])
    whole = evaluate(part, trajectory(reference))
    cut = evaluate(part, Trajectory(times[6:18] - 0.004, reference[6:18]))
    assert (whole.matched, whole.coverage, cut.coverage) == (12, 0.5, 1.0)
    assert (whole.ate_percent, whole.rpe_translation) == (cut.ate_percent, cut.rpe_translation)
    with pytest.raises(TrajectoryError, match=r"only 0 frames.*spans 0 to 2.3 s.*100 to 102.3 s"):
        evaluate(trajectory(reference), trajectory(reference, times + 100))


def test_frame_numbers_are_never_compared_with_seconds():
    """A trajectory without times beside one at 10 Hz: six of sixty frames matched, at the whole seconds."""
    reference, noisy = poses(noise=0.05, t=60)
    timed = trajectory(noisy)
    right = evaluate(timed, trajectory(reference))
    numbered = Trajectory(np.arange(60.0), reference, frames=60)
    with pytest.warns(TrajectoryWarning, match="the reference has no times.*60 frames.*60"):
        assert evaluate(timed, numbered) == right
    with pytest.warns(TrajectoryWarning, match="the estimate has no times"):
        assert evaluate(numbered, timed).matched == 60
    assert evaluate(Trajectory(np.arange(60.0), noisy, frames=60), numbered) == right
    part = Trajectory(np.arange(60.0)[6:18], noisy[6:18], frames=60)  # the others were NaN
    assert evaluate(part, numbered) == evaluate(Trajectory(timed.times[6:18], noisy[6:18]), trajectory(reference))
    few = Trajectory(np.arange(6.0), noisy[::10], frames=6)
    with pytest.raises(TrajectoryError, match=r"neither has times.* 6 frames .* 60.*times"):
        evaluate(few, numbered)
    with pytest.raises(TrajectoryError, match=r"the reference has no times \(KITTI.* 6 frames .* 60.*--times"):
        evaluate(Trajectory(timed.times[::10], noisy[::10]), numbered)


def test_trajectory_names_what_is_wrong():
    T = poses()[0][:4]
    times = np.arange(4.0)
    bad = T.copy()
    bad[2, 0, 0] = np.nan
    left_handed = T.copy()
    left_handed[1, :3, 0] *= -1
    cases = [
        ("at least one", (times[:0], T[:0])),
        ("T_world_camera has shape", (times, T[:3])),
        ("covariance has shape", (times, T, np.eye(6))),
        (r"T_world_camera\[2\] is not finite", (times, bad)),
        (r"times\[2\] = 1.0 does not come after", (np.asarray([0, 1, 1, 2.0]), T)),
        (r"T_world_camera\[1\] is no rigid", (times, left_handed)),
        ("whole numbers from 0 to 2", (times, T, None, None, 3)),
    ]
    for message, arguments in cases:
        with pytest.raises(TrajectoryError, match=message):
            Trajectory(*arguments)
    assert len(Trajectory(times, T, status=np.zeros(4, int))) == 4
