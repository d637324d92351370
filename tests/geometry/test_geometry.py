import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jaxlie import SO3

from jaxtri.geometry import epipolar, pose, trifocal

# From below every series' switch to the other side, and up to the far end of the logarithm.
ANGLES = [0.0, 1e-7, 2e-5, 4e-3, 0.09, 0.11, 1.0, 3.1]


exp_pose, log_pose = jax.jit(pose.exp_pose), jax.jit(pose.log_pose)
matrix_from_euler, euler_from_matrix = jax.jit(pose.matrix_from_euler), jax.jit(pose.euler_from_matrix)
sampson = jax.jit(jax.vmap(epipolar.sampson, (None, 0, 0)))
perpendicular_line = jax.jit(epipolar.perpendicular_line)
essential, retract, local = jax.jit(epipolar.essential), jax.jit(pose.retract), jax.jit(pose.local)
inverse_left_jacobian, compose = jax.jit(pose.inverse_left_jacobian), jax.jit(pose.compose)


@jax.jit
def slope_of_logarithm(at):
    return jax.jacfwd(lambda e: pose.log_pose(pose.retract(at, e)))(jnp.zeros(6))


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def directions(n, seed=0):
    v = np.random.default_rng(seed).normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def central(f, x, h=1e-6):
    columns = [(np.asarray(f(x + e)) - np.asarray(f(x - e))) / (2 * h) for e in h * np.eye(x.size)]
    return np.stack(columns, -1)


def check_derivatives(f, *points, rtol=1e-6, atol=1e-7):
    f, forward, reverse = jax.jit(f), jax.jit(jax.jacfwd(f)), jax.jit(jax.jacrev(f))
    for x in points:
        numerical = central(f, x)
        np.testing.assert_allclose(forward(x), numerical, rtol=rtol, atol=atol)
        np.testing.assert_allclose(reverse(x), numerical, rtol=rtol, atol=atol)


def scene(seed, n=20):
    """Three views that have `n` points in front of them."""
    rng = np.random.default_rng(seed)
    X = np.concatenate([rng.uniform(-1, 1, (n, 2)), rng.uniform(2, 6, (n, 1))], -1)
    Rs = [scipy.linalg.expm(skew(w)) for w in rng.normal(0, 0.15, (3, 3))]
    Ts = list(rng.normal(0, 0.4, (3, 3)))
    return jnp.asarray(X), [jnp.asarray(R) for R in Rs], [jnp.asarray(T) for T in Ts]


@jax.jit
def seen(X, R, T):
    camera = X @ R.T + T
    return camera[:, :2] / camera[:, 2:]


class TestPose:
    @staticmethod
    def point(seed):
        rng = np.random.default_rng(seed)
        rotations = [jax.jit(SO3.exp)(jnp.asarray(w)) for w in rng.normal(size=(2, 3))]
        return {
            "array": jnp.asarray(rng.normal(size=(2, 2))),
            "pose": compose(rotations[0], jnp.asarray(rng.normal(size=3))),
            "rotation": rotations[1],
        }

    def test_retract_and_local_are_inverse_on_a_composite_point(self):
        x, y = self.point(0), self.point(1)
        assert pose.tangent_dim(x) == 13
        delta = jnp.asarray(np.random.default_rng(2).normal(0, 0.5, 13))
        np.testing.assert_allclose(local(x, retract(x, delta)), delta, atol=1e-13)
        np.testing.assert_allclose(local(x, x), 0, atol=1e-14)
        there = retract(x, local(x, y))
        np.testing.assert_allclose(there["array"], y["array"], atol=1e-13)
        for name in ("pose", "rotation"):
            np.testing.assert_allclose(there[name].as_matrix(), y[name].as_matrix(), atol=1e-13)

    def test_retract_is_a_sum_and_left_products_in_the_order_of_the_leaves(self):
        x = self.point(3)
        delta = np.random.default_rng(4).normal(0, 0.5, 13)
        moved = retract(x, jnp.asarray(delta))
        np.testing.assert_allclose(moved["array"], x["array"] + delta[:4].reshape(2, 2), atol=1e-14)
        twist = np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = skew(delta[7:10]), delta[4:7]
        np.testing.assert_allclose(
            moved["pose"].as_matrix(), scipy.linalg.expm(twist) @ x["pose"].as_matrix(), atol=1e-13
        )
        np.testing.assert_allclose(
            moved["rotation"].as_matrix(),
            scipy.linalg.expm(skew(delta[10:])) @ x["rotation"].as_matrix(),
            atol=1e-13,
        )

    def test_exponential_and_logarithm_of_a_pose(self):
        axes, rho = directions(len(ANGLES)), 3 * directions(len(ANGLES), seed=1)
        xi = np.concatenate([rho, axes * np.array(ANGLES)[:, None]], -1)
        poses = jax.jit(jax.vmap(pose.exp_pose))(jnp.asarray(xi))
        np.testing.assert_allclose(jax.jit(jax.vmap(pose.log_pose))(poses), xi, atol=2e-13)
        for x, matrix in zip(xi, poses.as_matrix(), strict=True):
            twist = np.zeros((4, 4))
            twist[:3, :3], twist[:3, 3] = skew(x[3:]), x[:3]
            np.testing.assert_allclose(matrix, scipy.linalg.expm(twist), atol=1e-13)

    # jaxlie 1.5's own SE3.exp has twice the right derivative with respect to a small rotation.
    @pytest.mark.parametrize("angle", [a for a in ANGLES if a <= 1])
    def test_inverse_left_jacobian_is_the_derivative_of_the_logarithm(self, angle):
        xi = jnp.concatenate([jnp.array([0.3, -2.0, 0.7]), angle * directions(1)[0]])
        np.testing.assert_allclose(inverse_left_jacobian(xi), slope_of_logarithm(exp_pose(xi)), atol=3e-12)

    def test_derivatives_of_exponential_logarithm_and_local(self):
        axis = jnp.asarray(directions(1)[0])
        rho = jnp.array([1.0, -2.0, 3.0])
        points = [jnp.concatenate([rho, axis * angle]) for angle in (0.0, 1e-7, 4e-3, 0.1, 2.0)]
        other = exp_pose(jnp.linspace(0.0, 0.5, 6))

        def there_and_back(xi):
            moved = pose.retract(other, xi)
            return jnp.concatenate([moved.wxyz_xyz, pose.local(moved, other)])

        check_derivatives(there_and_back, *points)

    def test_adjoint_carries_a_twist_through_a_pose(self):
        x = self.point(5)["pose"]
        xi = jnp.asarray(np.random.default_rng(6).normal(size=6))
        left = np.asarray(exp_pose(pose.adjoint(x) @ xi).as_matrix()) @ x.as_matrix()
        np.testing.assert_allclose(left, np.asarray(x.as_matrix()) @ exp_pose(xi).as_matrix(), atol=1e-13)

    def test_logarithm_is_finite_up_to_half_a_turn(self):
        axis = jnp.asarray(directions(1, seed=3)[0])

        derivative = jax.jit(jax.jacrev(lambda xi: pose.log_pose(pose.exp_pose(xi))))
        for short in (0.0, 1e-12, 1e-6, 1e-3):
            xi = jnp.concatenate([axis, axis * (jnp.pi - short)])
            back = log_pose(exp_pose(xi))
            np.testing.assert_allclose(np.abs(back), np.abs(xi), atol=1e-9)
            assert np.isfinite(derivative(xi)).all()

    def test_euler_angles_are_a_product_of_elementary_rotations(self):
        for angles in np.random.default_rng(0).uniform([-1.5, -3, -3], [1.5, 3, 3], (10, 3)):
            yaw, pitch, roll = angles
            Rx = [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
            Ry = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
            Rz = [[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]]
            R = matrix_from_euler(jnp.asarray(angles))
            np.testing.assert_allclose(R, np.array(Rz) @ Ry @ Rx, atol=1e-14)
            np.testing.assert_allclose(euler_from_matrix(R), angles, atol=1e-12)
        np.testing.assert_allclose(pose.rotation_matrix(SO3.from_matrix(R)), R, atol=1e-14)
        np.testing.assert_allclose(pose.rotation_matrix(jnp.asarray(angles)), R, atol=1e-14)

    def test_float32_stays_float32_and_accurate(self):
        axes = directions(len(ANGLES)) * np.array(ANGLES)[:, None]
        xi = jnp.asarray(np.concatenate([3 * directions(len(ANGLES), seed=1), axes], -1), jnp.float32)
        poses = jax.jit(jax.vmap(pose.exp_pose))(xi)
        back = jax.jit(jax.vmap(pose.log_pose))(poses)
        assert poses.wxyz_xyz.dtype == back.dtype == jnp.float32
        np.testing.assert_allclose(back, xi, atol=1e-5)
        assert jax.eval_shape(jax.vmap(pose.adjoint), poses).dtype == jnp.float32


class TestEpipolar:
    def test_essential_is_the_skew_product_and_vanishes_on_real_points(self):
        X, (_, R, _), (_, T, _) = scene(0)
        E = essential(R, T)
        np.testing.assert_allclose(E, skew(T) @ R, atol=1e-15)
        u1, u2 = seen(X, jnp.eye(3), jnp.zeros(3)), seen(X, R, T)
        np.testing.assert_allclose(sampson(E, u1, u2), 0, atol=1e-15)

    def test_sampson_distance_agrees_with_opencv_up_to_its_sign(self):
        X, (_, R, _), (_, T, _) = scene(1)
        E = essential(R, T)
        noise = np.random.default_rng(0).normal(0, 0.05, (2, *X.shape[:1], 2))
        u1, u2 = seen(X, jnp.eye(3), jnp.zeros(3)) + noise[0], seen(X, R, T) + noise[1]
        distance = sampson(E, u1, u2)
        one, two = (np.asarray(epipolar.homogeneous(u)) for u in (u1, u2))
        expected = [cv2.sampsonDistance(a, b, np.asarray(E)) for a, b in zip(one, two, strict=True)]
        np.testing.assert_allclose(distance**2, expected, rtol=1e-10)
        np.testing.assert_array_equal(np.sign(distance), np.sign(np.einsum("ni,ij,nj->n", two, E, one)))

    def test_sampson_distance_has_the_noise_of_one_coordinate(self):
        X, (_, R, _), (_, T, _) = scene(2, n=4)
        E, sigma = essential(R, T), 1e-4
        noise = sigma * np.random.default_rng(0).normal(size=(2, 10_000, 4, 2))
        u1, u2 = seen(X, jnp.eye(3), jnp.zeros(3)) + noise[0], seen(X, R, T) + noise[1]
        distance = jax.vmap(sampson, (None, 0, 0))(E, u1, u2)
        # The standard deviation of 10,000 draws is known to 0.7 %.
        np.testing.assert_allclose(distance.std(0), sigma, rtol=0.03)

    def test_perpendicular_line(self):
        rng = np.random.default_rng(0)
        for u2, e2 in zip(rng.normal(size=(10, 2)), rng.normal(size=(10, 3)), strict=True):
            line = np.asarray(perpendicular_line(jnp.asarray(u2), jnp.asarray(e2)))
            np.testing.assert_allclose(line @ np.append(u2, 1), 0, atol=1e-14)
            direction, to_epipole = np.array([-line[1], line[0]]), e2[:2] / e2[2] - u2
            np.testing.assert_allclose(direction @ to_epipole / np.linalg.norm(to_epipole), 0, atol=1e-13)
            np.testing.assert_allclose(np.linalg.norm(line[:2]), 1, atol=1e-14)

    def test_inverse_depth_and_parallax_of_real_points(self):
        X, (_, R, _), (_, T, _) = scene(3)
        u1, u2 = seen(X, jnp.eye(3), jnp.zeros(3)), seen(X, R, T)
        inverse_depth = jax.jit(jax.vmap(epipolar.inverse_depth, (0, 0, None, None, None)))
        for e2 in (T, jnp.array([0.3, -2.0, 0.1])):  # the line need not be that of the true epipole
            inverse = inverse_depth(u1, u2, R, T, e2)
            np.testing.assert_allclose(inverse, 1 / X[:, 2], rtol=1e-12)
        centre = -R.T @ T
        a, b = np.asarray(X), np.asarray(X - centre)
        cosine = np.sum(a * b, 1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
        np.testing.assert_allclose(
            jax.jit(jax.vmap(epipolar.parallax, (0, 0, None)))(u1, u2, R), np.arccos(cosine), rtol=1e-9
        )

    def test_safe_functions_equal_the_plain_ones_away_from_zero(self):
        a, b = np.random.default_rng(0).normal(size=(2, 5, 3))
        np.testing.assert_allclose(epipolar.safe_divide(jnp.asarray(a), jnp.asarray(b)), a / b, rtol=1e-15)
        np.testing.assert_allclose(epipolar.safe_norm(jnp.asarray(a)), np.linalg.norm(a, axis=1), rtol=1e-15)
        np.testing.assert_array_equal(jax.grad(epipolar.safe_norm)(jnp.zeros(3)), 0)
        np.testing.assert_allclose(
            epipolar.dehomogenise(epipolar.homogeneous(jnp.asarray(a[:, :2])) * 3.0), a[:, :2], rtol=1e-15
        )


def trifocal_tensor(P2, P3):
    """T[i, j, k] of the cameras [I | 0], P2 and P3: Yu et al. 2006, eq. 8; Hartley & Zisserman 2004, eq. 15.1."""
    return jnp.einsum("ji,k->ijk", P2[:, :3], P3[:, 3]) - jnp.einsum("j,ki->ijk", P2[:, 3], P3[:, :3])


def transfer_by_tensor(T, u1, line2):
    """Homogeneous point of view 3: u''^k = u^i l'_j T_i^jk. Source: Yu et al. 2006, eq. 7."""
    return jnp.einsum("i,j,ijk->k", epipolar.homogeneous(u1), line2, T)


@jax.jit
def both_transfers(u1, u2, R2, T2, R3, T3):
    P2, P3 = jnp.concatenate([R2, T2[:, None]], 1), jnp.concatenate([R3, T3[:, None]], 1)
    tensor = trifocal_tensor(P2, P3)

    def one(a, b):
        by_tensor = transfer_by_tensor(tensor, a, epipolar.perpendicular_line(b, T2))
        return epipolar.dehomogenise(by_tensor), trifocal.transfer(a, b, R2, T2, R3, T3, T2)

    return jax.vmap(one)(u1, u2)


@jax.jit
def point_and_projection(u1, u2, R1, T1, R2, T2, R3, T3):
    X = jax.vmap(lambda a, b: trifocal.point_from_bases(a, b, R1, T1, R2, T2))(u1, u2)
    return X, jax.vmap(trifocal.project, (0, None, None))(X, R3, T3)


@jax.jit
def everything(u1, u2, R, T):
    X = trifocal.point_from_bases(u1, u2, R, T * 0.5, R.T, T)
    scalars = [
        epipolar.sampson(epipolar.essential(R, T), u1, u2),
        epipolar.inverse_depth(u1, u2, R, T, T),
        epipolar.parallax(u1, u2, R),
    ]
    points = [trifocal.transfer(u1, u2, R, T, R, T * 1.5, T), trifocal.project(X, R, T)]
    return jnp.concatenate([jnp.stack(scalars), epipolar.perpendicular_line(u2, T), *points])


everything_jacobian = jax.jit(jax.jacrev(everything, argnums=(0, 1, 2, 3)))


class TestTrifocal:
    def test_tensor_is_the_triple_loop_of_the_paper(self):
        a, b = np.random.default_rng(0).normal(size=(2, 3, 4))
        expected = np.zeros((3, 3, 3))
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    expected[i, j, k] = a[j, i] * b[k, 3] - a[j, 3] * b[k, i]
        np.testing.assert_allclose(trifocal_tensor(jnp.asarray(a), jnp.asarray(b)), expected, rtol=1e-14)

    @pytest.mark.parametrize("seed", range(3))
    def test_both_transfers_are_the_projection_of_the_real_point(self, seed):
        X, (_, R2, R3), (_, T2, T3) = scene(seed)
        u1, u2, u3 = seen(X, jnp.eye(3), jnp.zeros(3)), seen(X, R2, T2), seen(X, R3, T3)
        transferred = both_transfers(u1, u2, R2, T2, R3, T3)
        np.testing.assert_allclose(transferred[0], u3, atol=1e-12)
        np.testing.assert_allclose(transferred[1], u3, atol=1e-12)
        # Equal beside the truth too: the same line, the same point.
        noise = np.random.default_rng(seed).normal(0, 0.01, (2, *u1.shape))
        transferred = both_transfers(u1 + noise[0], u2 + noise[1], R2, T2, R3, T3)
        np.testing.assert_allclose(transferred[0], transferred[1], atol=1e-11)

    @pytest.mark.parametrize("seed", range(3))
    def test_point_from_any_two_bases(self, seed):
        X, (R1, R2, R3), (T1, T2, T3) = scene(seed)
        u1, u2, u3 = seen(X, R1, T1), seen(X, R2, T2), seen(X, R3, T3)
        point, transferred = point_and_projection(u1, u2, R1, T1, R2, T2, R3, T3)
        np.testing.assert_allclose(point[:, :3] / point[:, 3:], X, rtol=1e-11)
        np.testing.assert_allclose(point[:, 3], 1 / (X @ R1.T + T1)[:, 2], rtol=1e-11)
        np.testing.assert_allclose(transferred, u3, atol=1e-12)

    def test_derivatives_of_transfer_and_sampson(self):
        X, (_, R2, R3), (_, T2, T3) = scene(0, n=1)
        u1, u2 = seen(X, jnp.eye(3), jnp.zeros(3))[0], seen(X, R2, T2)[0]

        def residuals(x):
            a, b, R2_, R3_ = u1 + x[:2], u2 + x[2:4], SO3.exp(x[4:7]) @ R2, SO3.exp(x[7:10]) @ R3
            T2_, T3_ = T2 + x[10:13], T3 + x[13:]
            transferred = trifocal.transfer(a, b, R2_, T2_, R3_, T3_, T2)
            return jnp.append(transferred, epipolar.sampson(epipolar.essential(R2_, T2_), a, b))

        check_derivatives(residuals, jnp.zeros(16))

    @pytest.mark.parametrize("case", ["still", "epipole", "infinity", "forward", "zero"])
    @pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
    def test_degenerate_input_gives_finite_values_and_gradients(self, case, dtype):
        R, T = jnp.eye(3, dtype=dtype), jnp.array([0.3, 0.1, -0.2], dtype)
        u1 = jnp.array([0.2, -0.1], dtype)
        u2 = u1  # a point at infinity
        if case == "still":
            T = jnp.zeros(3, dtype)
        elif case == "epipole":
            u2 = T[:2] / T[2]
        elif case in ("forward", "zero"):
            T = jnp.array([0.0, 0.0, 1.0], dtype)
        if case == "zero":
            u1 = u2 = jnp.zeros(2, dtype)

        value = everything(u1, u2, R, T)
        assert value.dtype == dtype
        assert np.isfinite(value).all()
        for J in everything_jacobian(u1, u2, R, T):
            assert np.isfinite(J).all()
        if case == "infinity":
            assert abs(value[1]) < 1e-6  # the inverse depth
