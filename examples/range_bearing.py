"""A target that beacons see by range and bearing, a tenth of it wrong and a fifth missing: twenty trials in a batch."""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxtri import Belief, Robust, batch, ekf, tuning
from jaxtri.geometry import pose


class Target(eqx.Module):
    noises: jax.Array  # of range and bearing; the state is position and velocity, an item is a beacon
    retract, local = staticmethod(pose.retract), staticmethod(pose.local)

    def predict(self, mean, dt):
        return mean.at[:2].add(dt * mean[2:])

    def process_noise(self, mean, dt):
        return 0.01**2 * jnp.kron(jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), jnp.eye(2))

    def measure(self, mean, item):
        return jnp.array([jnp.hypot(*(mean[:2] - item)), jnp.arctan2(*(mean[:2] - item)[::-1])])

    def residual(self, observed, predicted):
        error = observed - predicted
        return error.at[1].set((error[1] + jnp.pi) % (2 * jnp.pi) - jnp.pi)

    def noise(self, mean, item):
        return jnp.diag(self.noises**2)


model, prior = Target(jnp.array([0.1, 0.02])), Belief(jnp.zeros(4), jnp.eye(4))
beacons = jnp.array([[5.0, 0.0], [0.0, 5.0], [-4.0, 3.0], [2.0, -3.0]])
truth, draws = jnp.linspace(0, jnp.array([6.0, 3.0]), 60), jax.random.normal(jax.random.key(0), (3, 20, 60, 4, 2))
noise = jnp.where(draws[1, ..., :1] > 1.28, 2 * draws[2], model.noises * draws[0])
data = jax.vmap(jax.vmap(model.measure, (None, 0)), (0, None))(truth, beacons) + noise, draws[1, ..., 1] > -0.84
run = jax.jit(lambda model: batch(lambda x: ekf.filter(model, prior, beacons, *x, robust=Robust()), data))
error = batch(lambda x: ekf.smooth(model, x), run(model)[0]).mean[..., :2] - truth
slope = model.noises * jax.grad(lambda model: tuning.negative_log_likelihood(run(model)[1]))(model).noises
print(f"{jnp.sqrt(jnp.mean(error**2)):.3f} off, rms; slope of the loss by the log noises {slope}, 0 is best")
