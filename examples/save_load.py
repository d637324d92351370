"""Half of the frames today and half tomorrow: an odometry kept in a file goes on as if it had never stopped."""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxtri import Belief, Camera, Odometry, load, save
from jaxtri.synthetic import steady_experiment

jax.config.update("jax_enable_x64", True)

folder = Path(tempfile.mkdtemp())
truth = steady_experiment(jax.random.key(0), orbit=True, degrees_per_frame=(0.3, 1.0, 0.0), n_points=60, n_frames=30)
camera = Camera.from_parameters(600, 600, 320, 240, width=640, height=480)
frames = camera.to_pixels(truth.observed)


def follow(odometry, first, last):
    for k in range(first, last):
        odometry.add(frames[k], np.ones(60, bool), k / 25)
    return odometry


follow(Odometry(camera), 0, 15).save(folder / "odometry.npz")
resumed = follow(Odometry.load(folder / "odometry.npz"), 15, 30)
at_once = follow(Odometry(camera), 0, 30)
same = np.array_equal(resumed.trajectory().T_world_camera, at_once.trajectory().T_world_camera)
print(f"{len(resumed.poses)} poses, {resumed.status.name.lower()}; the same as without a stop: {same}")

# Beliefs, models, settings, recordings, and lists and dictionaries of such, are kept the same way.
save(folder / "belief.npz", {"frame": 15, "belief": Belief(jnp.zeros(3), jnp.eye(3))})
kept = load(folder / "belief.npz")
print(f"frame {kept['frame']}: {kept['belief'].mean} with deviations {jnp.sqrt(jnp.diag(kept['belief'].covariance))}")
