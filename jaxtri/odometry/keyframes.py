"""What the errors of keyframes do to every later pose.

The filter measures as if the points were exact but for their own errors, which is what makes it O(N); the errors of the
keyframes that the points are known from are not forgotten, though. They are consider parameters (Schmidt 1966): the
error of the current pose is its own, of the covariance the filter reports, plus a linear function of the keyframes'
errors, the `sensitivity`. So the drift of a long sequence, its scale included, stands in the covariance of every pose.
"""

from jaxtyping import Array, Float


def carry(
    sensitivity: Float[Array, "d s"],
    transition: Float[Array, "d d"],
    covariance: Float[Array, "d d"],
    information: Float[Array, "m m"],
    coupling: Float[Array, "m s"],
) -> Float[Array, "d s"]:
    """The sensitivity after a prediction and an update: B <- (I - P A) F B - P C.

    P is the posterior `covariance`; `information` A = sum w H' D^-1 H and `coupling` C = sum w H' D^-1 J are what
    the update's measurements say of the first m components of the error, those of the pose at least, and of these
    together with the keyframes (`jaxtri.filters.projective`).
    """
    moved, m = transition @ sensitivity, len(information)
    return moved - covariance[:, :m] @ (information @ moved[:m] + coupling)


def total(
    own: Float[Array, "6 6"], keyframes: Float[Array, "s s"], sensitivity: Float[Array, "d s"]
) -> Float[Array, "6 6"]:
    """Covariance of the current pose: its `own`, and what the errors of the keyframes add to it."""
    B = sensitivity[:6]
    return own + B @ keyframes @ B.T
