"""From points as a lens made them back to those of a pinhole, for any lens."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtri.geometry.lenses import FARTHEST, Lens

# Newton doubles the radius at most, from 1: enough steps for 89.9 degrees off the axis of a fisheye lens,
# and for a dozen rejected steps near the fold of a strong barrel distortion.
_STEPS = 30


@jax.jit  # for eager callers: the loop is compiled once, not at every call
def undistort(distortion: Lens, xy: Float[Array, "2"]) -> Float[Array, "2"]:
    """Invert `distortion.distort` at one distorted normalised point.

    Derivatives with respect to the point and the coefficients are those of the implicit function theorem,
    to first order. A point that no ray reaches (beyond the fold of a barrel distortion, or 90 degrees and
    more off the axis) gives the nearest reachable one that was found, with derivatives of zero. To find out,
    distort the result again.
    """
    # The loop is not differentiated: one Newton step from its result has the derivatives, whatever path
    # led there, and reverse mode keeps nothing of the path.
    frozen = jax.tree.map(jax.lax.stop_gradient, distortion)
    target = jnp.clip(jax.lax.stop_gradient(xy), -FARTHEST, FARTHEST)
    identity = jnp.eye(2, dtype=xy.dtype)

    def residual(z):
        r = frozen.distort(z) - target
        return r, r

    # Levenberg-Marquardt from the centre, not from the distorted point: the first root on the way out is
    # the physical one, and a start beyond the fold finds mirrored ones.
    def step(_, carry):
        z, r, J, damping = carry
        delta = -_solve2(J.T @ J + damping * identity, J.T @ r)
        size2, reach2 = delta @ delta, 1 + z @ z
        delta = delta * jnp.sqrt(jnp.minimum(1, reach2 / jnp.where(size2 > 0, size2, 1)))
        J_new, r_new = jax.jacfwd(residual, has_aux=True)(z + delta)
        better = r_new @ r_new < r @ r  # False for NaN
        kept = [jnp.where(better, a, b) for a, b in ((z + delta, z), (r_new, r), (J_new, J))]
        return *kept, jnp.where(better, damping / 10, jnp.minimum(damping * 10, 1e6))

    # At the centre every lens but enlarges, to first order.
    start = (jnp.zeros_like(target), -target, frozen.magnification * identity, jnp.asarray(1e-4, xy.dtype))
    z, r, J, _ = jax.lax.fori_loop(0, _STEPS, step, start)
    eps = float(jnp.finfo(xy.dtype).eps)
    solved = (r @ r < eps * (1 + target @ target)) & (jnp.abs(_det2(J)) > eps)
    # An unsolved point is replaced before the step, so that neither its value nor its gradient is NaN.
    J = jnp.where(solved, J, identity)
    correction = _solve2(J, distortion.distort(jnp.where(solved, z, 0)) - jnp.where(solved, xy, 0))
    return jnp.where(solved, z - correction, z)


def _det2(A: Float[Array, "2 2"]) -> Float[Array, ""]:
    return A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]


def _solve2(A: Float[Array, "2 2"], b: Float[Array, "2"]) -> Float[Array, "2"]:
    det = _det2(A)
    adjugate_b = jnp.stack([A[1, 1] * b[0] - A[0, 1] * b[1], A[0, 0] * b[1] - A[1, 0] * b[0]])
    return adjugate_b / jnp.where(det == 0, 1, det)
