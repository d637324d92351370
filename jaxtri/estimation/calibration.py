"""What keyframes and points say of the camera's intrinsics: they are common to all observations.

Unknown are the logarithm of the focal length, the principal point in focal lengths and, of a lens with Brown's
coefficients or none, k1 and k2. Poses and points are eliminated. What is said is that of the image points, by the slope
of where a pixel is seen at, taken where the estimate sees it and not where it was observed: so noise of the points
pulls nowhere, to first order. A focal length that changes on the way is that of all plus what knots say of each
keyframe: the slope by its logarithm is the same for every focal length.
Source: Triggs et al. 2000, sections 6 and 8.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from jaxtri.estimation.batch import assembled, free_errors
from jaxtri.estimation.bundle import Linearised, Points, Reduced
from jaxtri.estimation.layers import Batch, Chunk, Noise
from jaxtri.estimation.precision import Precision
from jaxtri.estimation.tridiagonal import Factors
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.lenses import BrownConrady

PINHOLE, RADIAL = 3, 2  # unknown of a pinhole, and of a lens of Brown's
AROUND = 1.5  # farthest from the middle that a point counts at, over the farthest coordinate that was observed


def unknown(camera: Camera) -> int:
    """How many intrinsics of a camera can be estimated."""
    return PINHOLE + RADIAL * isinstance(camera.distortion, BrownConrady)


def with_lens(camera: Camera) -> Camera:
    """The camera with a lens of Brown's without distortion, where it has none."""
    return (
        camera
        if camera.distortion is not None
        else replace(camera, distortion=BrownConrady(jnp.zeros_like(camera.fx, shape=(8,))))
    )


def changed(camera: Camera, by: Float[Array, " p"]) -> Camera:
    """The camera with other intrinsics.

    Its focal lengths are multiplied by exp(by[0]), its principal point moves by by[1:3] of them, and the rest is added
    to k1 and k2.
    """
    fx, fy = camera.fx * jnp.exp(by[0]), camera.fy * jnp.exp(by[0])
    camera = replace(camera, fx=fx, fy=fy, cx=camera.cx + by[1] * fx, cy=camera.cy + by[2] * fy)
    lens = camera.distortion
    if len(by) == PINHOLE or lens is None:
        return camera
    return replace(camera, distortion=replace(lens, coefficients=lens.coefficients.at[:RADIAL].add(by[PINHOLE:])))


def difference(camera: Camera, other: Camera) -> Float[Array, " p"]:
    """What `changed` makes of a camera the intrinsics of another by."""
    centre = (other.cx - camera.cx) / other.fx, (other.cy - camera.cy) / other.fy
    by = jnp.stack([jnp.log(other.fx / camera.fx), *centre])
    if unknown(camera) == PINHOLE or camera.distortion is None or other.distortion is None:
        return by
    return jnp.concatenate([by, (other.distortion.coefficients - camera.distortion.coefficients)[:RADIAL]])


def slope(camera: Camera, u: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2 p"]:
    """Derivative of where a camera sees its pixels at, normalised, by its intrinsics; at the normalised points u."""
    zero = jnp.zeros(unknown(camera), u.dtype)

    def one(u: Array) -> Array:
        by_point = jax.jacfwd(camera.to_pixels)(u)
        by_intrinsics = jax.jacfwd(lambda by: changed(camera, by).to_pixels(u))(zero)
        return -jnp.linalg.solve(by_point, by_intrinsics)

    return jnp.vectorize(one, signature="(i)->(i,p)")(u)


class Told(NamedTuple):
    """What is known of p intrinsics and knots, whatever the poses and the points.

    Attributes:
        information: (p, p) by the noise that is assumed.
        pull: (p,) its right side: the slope of the cost, with the other sign.
        response: (k, 6, p) what a change of the intrinsics does to the poses, left perturbations.
        scores: Of each layer, (c, p, n): what each track has in the pull.
    """

    information: Float[Array, "p p"]
    pull: Float[Array, " p"]
    response: Float[Array, "k 6 p"]
    scores: tuple[Float[Array, "c p n"], ...]

    def first(self, count: int) -> "Told":
        """Of the first intrinsics and knots alone; the others as given."""
        cut = self.information[:count, :count], self.pull[:count], self.response[..., :count]
        return Told(*cut, tuple(score[:, :count] for score in self.scores))


class _Part(NamedTuple):
    """What a chunk says."""

    information: Float[Array, "p p"]
    cross: Float[Array, "v 6 p"]  # the information that the intrinsics share with its poses
    pull: Float[Array, "p n"]
    of_poses: Float[Array, "v 6 n"]  # the pull on the poses


@jax.jit
def told(
    batch: Batch,
    noise: Noise,
    poses: SE3,
    points: tuple[Points, ...],
    camera: Camera,
    knots: Float[Array, "k m"] | None = None,
) -> Told:
    """Of the intrinsics of the camera that the observations were normalised by, at a least cost for the points.

    With `knots` what they say of the logarithm of the focal length is unknown, too: that of a keyframe is its row times
    them more. They stand behind the intrinsics.
    """
    share = jnp.zeros((len(batch.present), 0), noise.sigma.dtype) if knots is None else knots
    p = unknown(camera) + share.shape[1]

    def one(chunk: Chunk, said: Linearised, reduced: Reduced) -> _Part:
        v, n = said.weights.shape
        u = jnp.moveaxis(chunk.observed, 0, -1) - noise.sigma * jnp.moveaxis(said.residual, 1, -1)
        # An outlier may be estimated far outside of the picture, where a lens has no slope; it hardly weighs.
        widest, far = AROUND * jnp.max(jnp.abs(chunk.observed)), jnp.linalg.norm(u, axis=-1, keepdims=True)
        u = jnp.where(far > widest, u * widest / jnp.where(far > widest, far, 1.0), u)
        common = jnp.moveaxis(slope(camera, u), (0, 1, 2, 3), (0, 3, 2, 1)) / noise.sigma  # (v, p, 2, n)
        common = jnp.concatenate([common, common[:, :1] * chunk.of(share)[:, :, None, None]], axis=1)
        common = jnp.where((said.weights > 0)[:, None, None], common, 0.0)
        precision = Precision.of(said.weights, said.kept)
        heavy, left = precision @ common, precision @ said.residual
        # A change of the intrinsics adds to the residuals; poses and points take off from them.
        rooted = jnp.einsum("tsn,psn->ptn", reduced.root, jnp.einsum("ksan,kpan->psn", said.point, heavy))
        cross = jnp.einsum("kean,kpan->kep", said.pose, heavy).reshape(6 * v, p)
        of_poses = jnp.einsum("kean,kan->ken", said.pose, left).reshape(6 * v, n)
        return _Part(
            jnp.einsum("kpan,kqan->pq", common, heavy) - jnp.einsum("ptn,qtn->pq", rooted, rooted),
            (cross - jnp.einsum("etn,ptn->ep", reduced.cross, rooted)).reshape(v, 6, p),
            jnp.einsum("ptn,tn->pn", rooted, reduced.offset) - jnp.einsum("kpan,kan->pn", common, left),
            (of_poses - jnp.einsum("etn,tn->en", reduced.cross, reduced.offset)).reshape(v, 6, n),
        )

    none = jnp.zeros((), noise.sigma.dtype)
    _, equations, parts = assembled(batch, noise, poses, points, none, one)
    cross = jnp.zeros((len(batch.present), 6, p), noise.sigma.dtype)
    frames = [layer.begin[:, None] + jnp.arange(2 * layer.size) for layer in batch.layers]
    for part, at in zip(parts, frames, strict=True):
        cross = cross.at[at].add(part.cross)
    cross = jnp.einsum("kab,kbp->kap", free_errors(batch, poses), cross)
    solve = Factors.of(equations, none).solve
    response = jax.vmap(solve, in_axes=-1, out_axes=-1)(cross.reshape(*equations.pull.shape, p)).reshape(cross.shape)
    scores = tuple(
        part.pull + jnp.einsum("cvep,cven->cpn", response[at], part.of_poses)
        for part, at in zip(parts, frames, strict=True)
    )
    information = jnp.sum(jnp.concatenate([part.information for part in parts]), axis=0)
    information = information - jnp.einsum("kep,keq->pq", cross, response)
    pull = sum((jnp.sum(score, axis=(0, 2)) for score in scores), jnp.zeros(p, noise.sigma.dtype))
    return Told(information, pull, response, scores)
