"""A model of your own: a pendulum, filtered and smoothed from the bearing under which its bob is seen."""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxtri import Belief, ekf
from jaxtri.geometry import pose

jax.config.update("jax_enable_x64", True)


class Pendulum(eqx.Module):
    sigma: float  # of a bearing, radians
    gust: float  # of what the motion leaves out, radians per second^1.5
    retract, local = staticmethod(pose.retract), staticmethod(pose.local)  # of an array, angle and rate: sums

    def predict(self, mean, dt):
        rate = mean[1] - 9.81 * dt * jnp.sin(mean[0])
        return jnp.array([mean[0] + dt * rate, rate])

    def process_noise(self, mean, dt):
        return self.gust**2 * jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])

    def measure(self, mean, item):  # one metre long, hung at the origin, seen from (-1, -2)
        return jnp.arctan2(2 - jnp.cos(mean[0]), 1 + jnp.sin(mean[0]))[None]

    def noise(self, mean, item):
        return self.sigma**2 * jnp.eye(1)


model, dt = Pendulum(sigma=0.05, gust=0.2), 0.02
kicks, errors = jax.random.normal(jax.random.key(0), (2, 400)) * jnp.array([[model.gust * dt**0.5], [model.sigma]])
truth = jax.lax.scan(lambda x, kick: (model.predict(x, dt).at[1].add(kick),) * 2, jnp.array([1.0, 0.0]), kicks)[1]
observed = jax.vmap(model.measure, (0, None))(truth, None) + errors[:, None]
filtered, said = ekf.filter(model, Belief(jnp.zeros(2), jnp.eye(2)), None, observed[:, None], dt=dt)
for name, belief in (("filtered", filtered), ("smoothed", ekf.smooth(model, filtered, dt))):
    rms = jnp.sqrt(jnp.mean((belief.mean[:, 0] - truth[:, 0]) ** 2))
    print(f"{name}: the angle is {jnp.rad2deg(rms):.2f} degrees off, rms")
