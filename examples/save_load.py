"""Keep a run in a file and go on from it later, as if it had never stopped; the same with a filter's belief."""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxtri import Belief, Camera, Kinematics, Odometry, load, save

jax.config.update("jax_enable_x64", True)

# Points before a camera that slides to the right, 3 cm a frame; tracks with a noise of 0.3 pixels.
rng, frames = np.random.default_rng(0), 30
points = rng.uniform([-2, -1.5, 3], [2, 1.5, 5], (80, 3))
X = points - np.arange(frames)[:, None, None] * [0.03, 0.0, 0.0]
pixels = 500 * X[..., :2] / X[..., 2:] + [320, 240] + rng.normal(scale=0.3, size=(frames, 80, 2))
visible = ((pixels > 0) & (pixels < [640, 480])).all(axis=2)
camera = Camera.from_parameters(500, 500, 320, 240, width=640, height=480)


def feed(odometry, those):
    for k in those:
        odometry.add(pixels[k], visible[k], time=k / 25)
    return odometry


folder = Path(tempfile.mkdtemp())
feed(Odometry(camera), range(15)).save(folder / "half.npz")
resumed = feed(Odometry.load(folder / "half.npz"), range(15, frames)).trajectory()
whole = feed(Odometry(camera), range(frames)).trajectory()
apart = np.abs(resumed.T_world_camera - whole.T_world_camera).max()
print(f"{len(resumed)} poses, saved after 15 and gone on with: {apart} apart from those of a run without a stop")

still = Kinematics(jnp.zeros(3), jnp.zeros(3), jnp.zeros(3), jnp.zeros(3))
save(folder / "belief.npz", Belief(still, jnp.eye(12)))
print("arrays in belief.npz:", sorted(np.load(folder / "belief.npz")), "->", type(load(folder / "belief.npz").mean))
