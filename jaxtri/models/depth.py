"""The scene: one small filter per point, given the pose. Source: Yu et al. 2006, sections V and VI.

A point is one parameter along the ray of the image point where it was first seen, in the camera of that
frame. N such filters, in closed form and batched, follow the pose filter: O(N) a frame, and the pose does
not depend on them.

The ray itself was measured once, with the noise of one image point, and that error never averages out. So
each filter also carries the covariance of its ray: it may be ignored (`ray_sigma` of zero, the paper),
considered (Schmidt 1966: one parameter is estimated, its variance is right) or estimated along (`rays`, the
default; the measurement biases of Azarbayejani & Pentland 1995, section III).
"""

from collections.abc import Callable
from functools import partial
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from jaxtri.checks import number
from jaxtri.estimation.two_view import TwoView
from jaxtri.filters.linalg import linearised
from jaxtri.filters.masks import select
from jaxtri.geometry.epipolar import dehomogenise, homogeneous, inverse_depth
from jaxtri.geometry.pose import identity

SMALLEST = 1e-3  # inverse depth over the median's, of the farthest depth: one near zero has no depth, or a negative one


class Bank(NamedTuple):
    """N points, in slots; a slot whose track has ended keeps its last estimate until another point is born in it.

    Attributes:
        parameter: (n,) inverse depth, or depth, in the camera of first sight, 1 / scene units or scene units.
        ray: (n, 2) normalised image point of first sight.
        covariance: (n, 3, 3) of the errors (parameter, ray).
        birth: (n,) pose of the camera of first sight, world to camera.
    """

    parameter: Float[Array, " n"]
    ray: Float[Array, "n 2"]
    covariance: Float[Array, "n 3 3"]
    birth: SE3


class WorldPoint(NamedTuple):
    """A point in the world and how well it is known.

    Attributes:
        point: (4,) homogeneous, scene units.
        covariance: (4, 4) of the error of `point`.
    """

    point: Float[Array, "4"]
    covariance: Float[Array, "4 4"]


class Depth(eqx.Module):
    """The filter of one point; every field but the last three is a leaf. Times are in frames.

    Attributes:
        sigma: Standard deviation of an image point in normalised image units: noise_px / focal length.
        ray_sigma: The same of the image point of first sight. `Depth.of` takes `sigma` for it, which is what it is. 0
            takes the ray as exact, as in the paper: that error never averages out, and the covariance does not know it.
        drift: Standard deviation of the parameter's change per frame, relative to the parameter (eq. 13). 0 by default:
            the scene is static. The paper needs it, because it starts from a plane.
        gate: Squared Mahalanobis distance of an innovation (two components) above which it is left out. Infinite by
            default: the filter of the pose has left the outliers out already.
        rays: Estimate the ray along with the parameter (static). Without, one number cannot explain the images better
            than the noise of the first one allows.
        inverse: The parameter is the inverse depth (static), in which the projection is all but linear. Off, the
            paper's depth itself, which a wrong start may throw off for good.
        passes: Linearisations of an update (static). Two by default: the first corrects the depth, the second
            linearises there.
    """

    normalised: ClassVar[bool] = True
    """What the model measures are normalised image points: `jaxtri.checks` warns of pixels."""

    sigma: Float[Array, ""] = eqx.field(converter=number)
    ray_sigma: Float[Array, ""] = eqx.field(converter=number)
    drift: Float[Array, ""] = eqx.field(converter=number)
    gate: Float[Array, ""] = eqx.field(converter=number)
    rays: bool = eqx.field(static=True, default=True)
    inverse: bool = eqx.field(static=True, default=True)
    passes: int = eqx.field(static=True, default=2)

    @classmethod
    def of(cls, sigma: Float[Array, ""], *, gate: Float[Array, ""] | float = jnp.inf, rays: bool = True) -> "Depth":
        """The default model: inverse depth, the ray estimated (or, with `rays` False, considered), no drift."""
        sigma = number(sigma)
        return cls(sigma, sigma, jnp.zeros_like(sigma), jnp.asarray(gate, sigma.dtype), rays)

    @classmethod
    def paper(
        cls, sigma: Float[Array, ""], *, drift: Float[Array, ""] | float = 0.01, inverse: bool = False
    ) -> "Depth":
        """The model as published: depth along an exact ray, one pass, process noise because the start is a plane.

        With `inverse` the parameter is the inverse depth instead, in which the projection is all but linear. As a
        depth, a point far from the plane is thrown off by its first update and may never come back.
        """
        sigma = number(sigma)
        drift = jnp.asarray(drift, sigma.dtype)
        gate = jnp.full((), jnp.inf, sigma.dtype)
        return cls(sigma, jnp.zeros_like(sigma), drift, gate, rays=False, inverse=inverse, passes=1)

    def plane(
        self,
        observed: Float[Array, "n 2"],
        pose: SE3,
        z_init: Float[Array, ""] | float,
        relative_sd: Float[Array, ""] | float = 1.0,
    ) -> Bank:
        """All points on a plane at depth `z_init` before the camera. Source: Yu et al. 2006, eq. 12.

        `observed` are normalised image points, `pose` is that of the camera, world to camera, `z_init` in scene units.
        `relative_sd` is the standard deviation of the parameter over its value.
        """
        n, dtype = observed.shape[0], observed.dtype
        observed = _there(observed)
        z_init = jnp.asarray(z_init, dtype)
        start = jnp.full(n, 1.0, dtype) * (1 / z_init if self.inverse else z_init)
        return self._bank(observed, start, jnp.square(relative_sd * start), pose)

    def _bank(self, ray: Array, parameter: Array, variance: Array, pose: SE3) -> Bank:
        birth = jax.tree.map(lambda x: jnp.broadcast_to(x.astype(ray.dtype), (len(ray), *x.shape)), pose)
        ray_variance = jnp.broadcast_to(jnp.square(self.ray_sigma).astype(ray.dtype), (len(ray), 2))
        diagonal = jnp.concatenate([variance[:, None], ray_variance], axis=1)
        return Bank(parameter, ray, jax.vmap(jnp.diag)(diagonal), birth)

    def born(
        self,
        bank: Bank,
        fresh: Bool[Array, " n"],
        observed: Float[Array, "n 2"],
        pose: SE3,
        z_init: Float[Array, ""] | float,
        relative_sd: Float[Array, ""] | float = 1.0,
    ) -> Bank:
        """The bank with new points in the `fresh` slots, seen first at `pose`. Source: Yu et al. 2006, eq. 18."""
        new = self.plane(observed, pose, z_init, relative_sd)
        return select(fresh, new, bank)

    def step(
        self,
        bank: Bank,
        pose: SE3,
        observed: Float[Array, "n 2"],
        mask: Bool[Array, " n"],
        pose_covariance: Float[Array, "6 6"] | None = None,
        dt: Float[Array, ""] | float = 1.0,
    ) -> Bank:
        """One frame: predict and update the points that are seen, given the pose. Source: eqs 16-17.

        `observed` are normalised image points. `pose_covariance` is that of the pose's left perturbation (linear,
        angular), taken as independent from frame to frame; zero by default. What the errors of the poses have in
        common, a drift or the scale, is in no point's covariance. Masked points stay as they are: a point whose track
        has ended keeps its last estimate.
        """
        if pose_covariance is None:
            pose_covariance = jnp.zeros((6, 6), observed.dtype)
        observed = jnp.where(mask[:, None], observed, bank.ray)
        R, T = pose.rotation().as_matrix(), pose.translation()
        drift = jnp.square(self.drift) * dt

        def one(parameter: Array, ray: Array, C: Array, birth: SE3, z: Array) -> tuple[Array, Array, Array]:
            R1, T1 = birth.rotation().as_matrix(), birth.translation()
            A = R @ R1.T
            prior = jnp.concatenate([parameter[None], ray])
            camera = partial(self._in_camera, A=A, b=T - A @ T1)
            C = C.at[0, 0].add(drift * jnp.square(parameter))
            return self._update(camera, prior, C, self._noise(camera(prior), parameter, pose_covariance), z)

        x, C, good = jax.vmap(one)(bank.parameter, bank.ray, bank.covariance, bank.birth, observed)
        good &= mask
        drifted = bank.covariance.at[:, 0, 0].add(jnp.where(mask, drift * jnp.square(bank.parameter), 0.0))
        return Bank(
            jnp.where(good, x[:, 0], bank.parameter),
            jnp.where(good[:, None], x[:, 1:], bank.ray),
            jnp.where(good[:, None, None], C, drifted),
            bank.birth,
        )

    def _in_camera(self, x: Float[Array, "3"], *, A: Float[Array, "3 3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
        """The point (parameter, ray), up to scale, in a camera of the pose (A, b) relative to that of its birth."""
        turned = A @ homogeneous(x[1:])
        return turned + x[0] * b if self.inverse else x[0] * turned + b

    def _noise(
        self, X: Float[Array, "3"], parameter: Float[Array, ""], pose_covariance: Float[Array, "6 6"]
    ) -> Float[Array, "2 2"]:
        """Covariance of an observation of the point believed to be at X in the camera, the pose's part in it."""

        def moved(error: Array) -> Array:
            # The left perturbation of the pose, to first order.
            return dehomogenise(X + (parameter if self.inverse else 1.0) * error[:3] + jnp.cross(error[3:], X))

        G = jax.jacfwd(moved)(jnp.zeros(6, X.dtype))
        return jnp.square(self.sigma) * jnp.eye(2, dtype=X.dtype) + G @ pose_covariance @ G.T

    def _update(
        self,
        camera: Callable[[Array], Array],
        prior: Float[Array, "3"],
        C: Float[Array, "3 3"],
        D: Float[Array, "2 2"],
        z: Float[Array, "2"],
    ) -> tuple[Float[Array, "3"], Float[Array, "3 3"], Bool[Array, ""]]:
        """One point's iterated update by its observation z of covariance D, and whether it may be taken."""

        def linearise(x: Array) -> tuple[Array, Array, Array]:
            """Innovation and Jacobian at x, and the inverse of the innovation's covariance."""
            y, H = linearised(lambda x: dehomogenise(camera(x)), x)
            return z - y - H @ (prior - x), H, _inverse_2x2(H @ C @ H.T + D)

        def gain(H: Array, inverse: Array) -> Array:
            K = C @ H.T @ inverse
            return K if self.rays else K.at[1:].set(0.0)

        r, H, inverse = linearise(prior)
        inside = r @ inverse @ r <= self.gate
        for _ in range(self.passes - 1):
            r, H, inverse = linearise(prior + gain(H, inverse) @ r)
        K = gain(H, inverse)
        x = prior + K @ r
        # Joseph's form: positive whatever the gain, a considered ray's included.
        keep = jnp.eye(3, dtype=x.dtype) - K @ H
        updated = keep @ C @ keep.T + K @ D @ K.T
        return x, updated, inside & jnp.all(jnp.isfinite(x)) & jnp.all(jnp.isfinite(updated))

    def _homogeneous(self, x: Float[Array, "3"], R1: Float[Array, "3 3"], T1: Float[Array, "3"]) -> Float[Array, "4"]:
        """Homogeneous world point of (parameter, ray) in the camera (R1, T1). Source: Yu et al. 2006, eqs 15, 18."""
        ray = homogeneous(x[1:])
        if self.inverse:
            return jnp.concatenate([R1.T @ (ray - x[0] * T1), x[:1]])
        return jnp.concatenate([R1.T @ (x[0] * ray - T1), jnp.ones(1, x.dtype)])

    def world(self, bank: Bank, log_scale_variance: Float[Array, ""] | float = 0.0) -> WorldPoint:
        """The points in the world, homogeneous: shapes (n, 4) and (n, 4, 4).

        `log_scale_variance` is the variance of the logarithm of the scale of the whole scene about the world's origin,
        which no later frame can tell: see `scale_variance`.
        """

        def one(parameter: Array, ray: Array, C: Array, birth: SE3) -> WorldPoint:
            R1, T1 = birth.rotation().as_matrix(), birth.translation()
            x = jnp.concatenate([parameter[None], ray])
            J = jax.jacfwd(lambda y: self._homogeneous(y, R1, T1))(x)
            X = self._homogeneous(x, R1, T1)
            return WorldPoint(X, (J @ C @ J.T).at[3, 3].add(log_scale_variance * jnp.square(X[3])))

        return jax.vmap(one)(*bank)

    def triangulated(self, two_view: TwoView, first: Float[Array, "n 2"], second: Float[Array, "n 2"]) -> Bank:
        """The bank at the first of two views, the world, from their relative pose: the good start.

        `first` and `second` are normalised image points. A point's variance is that of its triangulation, and counts
        the error of the pose. What the errors of the points have in common is left out.
        """
        parameter, by_pose, by_noise = triangulate(two_view, first, second, inverse=self.inverse)
        spread = jnp.square(self.ray_sigma) * jnp.sum(by_noise[:, :2] ** 2, axis=1)
        spread += jnp.square(self.sigma) * jnp.sum(by_noise[:, 2:] ** 2, axis=1)
        pose = jnp.einsum("ni,ij,nj->n", by_pose, two_view.covariance, by_pose)
        bank = self._bank(_there(first), parameter, spread + pose, identity(first.dtype))
        cross = jnp.square(self.ray_sigma) * by_noise[:, :2]
        return bank._replace(covariance=bank.covariance.at[:, 0, 1:].set(cross).at[:, 1:, 0].set(cross))


def triangulate(
    two_view: TwoView, first: Float[Array, "n 2"], second: Float[Array, "n 2"], *, inverse: bool = True
) -> tuple[Float[Array, " n"], Float[Array, "n 6"], Float[Array, "n 4"]]:
    """Inverse depths (or depths) in the first view, and their derivatives.

    The derivatives are those with respect to the errors (T, R) of the pose, and to the two observations (normalised
    image points). A depth is at most a thousand times that of the median inverse depth.
    """
    pairs, zero = _there(jnp.concatenate([first, second], axis=-1)), jnp.zeros(6, first.dtype)

    def at(error: Array, pair: Array) -> Array:
        T, R = two_view.translation + error[:3], two_view.rotation.as_matrix()
        R = R + jnp.cross(error[3:], R.T).T  # exp(error) R, to first order
        return inverse_depth(pair[:2], pair[2:], R, T, T)

    smallest = SMALLEST * jnp.median(jax.vmap(lambda pair: at(zero, pair))(pairs))

    def parameter(error: Array, pair: Array) -> Array:
        return at(error, pair) if inverse else 1 / jnp.maximum(at(error, pair), smallest)

    def one(pair: Array) -> tuple[Array, Array, Array]:
        return parameter(zero, pair), *jax.grad(parameter, argnums=(0, 1))(zero, pair)

    return jax.vmap(one)(pairs)


def scale_variance(
    two_view: TwoView,
    first: Float[Array, "n 2"],
    second: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
    sigma: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Variance of the logarithm of the scale of a scene, given the length of the base line of two views.

    Only these two frames tell of the scale: later ones refine the shape alone. So its error is common to all depths,
    and does not average out. `sigma` is the noise of a normalised image point.
    """
    depth, by_pose, by_noise = triangulate(two_view, first, second)
    weight = jnp.where(mask, 1 / (jnp.square(sigma) * jnp.sum(by_noise**2, axis=1)), 0.0)
    G = jnp.concatenate([depth[:, None], by_pose], axis=1)
    A = jnp.einsum("n,ni,nj->ij", weight, G, G)
    C, App = two_view.covariance, A[1:, 1:]
    # The errors of the pose are eliminated; their covariance is singular along the base line.
    eliminated = C @ jnp.linalg.solve(jnp.eye(6, dtype=C.dtype) + App @ C, A[1:, 0])
    return 1 / (A[0, 0] - A[0, 1:] @ eliminated)


def _there(u: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """The points, with zero for what is not finite: masked or not, a NaN would make every gradient NaN."""
    return jnp.where(jnp.isfinite(u), u, jnp.zeros((), u.dtype))


def _inverse_2x2(S: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    # In closed form: batched LAPACK calls on tiny blocks are slow.
    det = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    return jnp.array([[S[1, 1], -S[0, 1]], [-S[1, 0], S[0, 0]]]) / det
