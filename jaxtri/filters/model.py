"""What a filter asks of its problem, and its motion: a belief on a manifold, predicted to the next frame."""

from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtri.checks import checked

Mean = TypeVar("Mean")


class Belief(eqx.Module, Generic[Mean]):
    """A Gaussian on a manifold: the true state is `retract(mean, delta)` with delta ~ N(0, covariance).

    Attributes:
        mean: The state, any pytree that the model can `retract`.
        covariance: (d, d) of the error delta; may be singular, as where a gauge is fixed.
    """

    mean: Mean
    covariance: Float[Array, "d d"]


@runtime_checkable
class Dynamics(Protocol[Mean]):
    """The state of a filter and its motion; every method is a pure function."""

    def retract(self, mean: Mean, delta: Float[Array, " d"]) -> Mean:
        """The state moved by an error."""
        ...

    def local(self, mean: Mean, other: Mean) -> Float[Array, " d"]:
        """The error that takes `mean` to `other`."""
        ...

    def predict(self, mean: Mean, dt: Float[Array, ""]) -> Mean:
        """The state one time step later."""
        ...

    def process_noise(self, mean: Mean, dt: Float[Array, ""]) -> Float[Array, "d d"]:
        """Covariance of what the motion model leaves out."""
        ...


@runtime_checkable
class Model(Dynamics[Mean], Protocol[Mean]):
    """What a filter asks of its problem; every method is a pure function of one item.

    A model may also have

    - `residual(observed, predicted)`, which compares the two where that is not their difference: a bearing is wrapped
      to (-pi, pi] there, a unit vector taken to its tangent plane. The noise is that of the residual.
    - an attribute `considered`, a boolean array (d,): error components that are counted with their covariance and
      never corrected (consider parameters, Schmidt 1966).
    - an attribute `normalised`, True where the measurements are normalised image points: pixels are warned of.
    """

    def measure(self, mean: Mean, item: Any) -> Float[Array, " m"]:
        """Predicted measurement of one item."""
        ...

    def noise(self, mean: Mean, item: Any) -> Float[Array, "m m"]:
        """Measurement noise of one item; may depend on the state."""
        ...


def _nearby(model: Dynamics[Mean], mean: Mean, other: Mean) -> Float[Array, " d"]:
    """`model.local`, or what has the same derivative where the two coincide."""
    return getattr(model, "difference", model.local)(mean, other)


def change_of_origin(model: Dynamics[Mean], mean: Mean, delta: Float[Array, " d"], moved: Mean) -> Float[Array, "d d"]:
    """Derivative of the error at `moved`, which is `retract(mean, delta)`, with respect to that at `mean`."""
    return jax.jacfwd(lambda e: _nearby(model, moved, model.retract(mean, delta + e)))(jnp.zeros_like(delta))


def transition(model: Dynamics[Mean], mean: Mean, dt: Float[Array, ""]) -> Float[Array, "d d"]:
    """Derivative of the error after one time step with respect to the error before it."""
    after = model.predict(mean, dt)

    def error(delta: Array) -> Array:
        return _nearby(model, after, model.predict(model.retract(mean, delta), dt))

    noise = model.process_noise(mean, dt)
    return jax.jacfwd(error)(jnp.zeros(noise.shape[0], noise.dtype))


@checked
def predict(model: Dynamics[Mean], belief: Belief[Mean], dt: Float[Array, ""] | float = 1.0) -> Belief[Mean]:
    """The belief one time step `dt` later."""
    P = belief.covariance
    dt = jnp.asarray(dt, P.dtype)
    F = transition(model, belief.mean, dt)
    return Belief(model.predict(belief.mean, dt), F @ P @ F.T + model.process_noise(belief.mean, dt))
