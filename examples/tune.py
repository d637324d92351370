"""Tune a noise by the likelihood of a filter's innovations: one that was told ten times too much is put right."""

import jax
import jax.numpy as jnp
from jaxlie import SO3

from jaxtri import Trifocal, ekf, tuning, two_view
from jaxtri.models.trifocal import start
from jaxtri.synthetic import paper_experiment

jax.config.update("jax_enable_x64", True)

# Sixty points before a camera that moves and turns; 0.1 px of noise at a focal length of 600 px.
truth = paper_experiment(jax.random.key(0), n_points=60, n_frames=40, phases=(2,))
first, second, later = truth.observed[0], truth.observed[4], truth.observed[5:]
guess = truth.translations[4], SO3.from_matrix(truth.rotations[4])
view = two_view.refine(*guess, first, second, jnp.ones(60, bool), truth.sigma)
belief = start(view, frames=4, velocity_sd=0.01, angular_velocity_sd=0.02)


def loss(model, observed):
    said = ekf.filter(model, belief, jnp.concatenate([first, second], axis=-1), observed)[1]
    return tuning.negative_log_likelihood(said)


told = Trifocal(*jnp.array([1.0 / 600, 0.01, 0.02, 0.0]), view.translation)  # a noise of 1 px
found = tuning.fit(told, later, {"sigma": tuning.Parameter(lambda model: model.sigma)}, loss, progress=False)
print(found)
print(f"noise: {600 * told.sigma:.3f} px told, {600 * found.model.sigma:.3f} px found, 0.1 px were put in")
