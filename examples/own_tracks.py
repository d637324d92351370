"""Feature tracks of your own: poses with covariances out of them, and the gradient of a whole run."""

from dataclasses import replace

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from jaxtri import Camera, Settings, Trajectory, evaluate, follow_tracks, replay

jax.config.update("jax_enable_x64", True)

# Points in a box, before a camera that slides to the right and turns; tracks with a noise of 0.3 pixels.
rng, frame = np.random.default_rng(0), np.arange(40)
points = rng.uniform([-2, -1.5, 3], [3, 1.5, 5], (100, 3))
truth = np.tile(np.eye(4), (len(frame), 1, 1))  # camera to world
truth[:, :3, :3] = Rotation.from_euler("y", 3 * np.sin(frame / 9)[:, None], degrees=True).as_matrix()
truth[:, 0, 3] = 0.03 * frame
X = np.einsum("tji,tnj->tni", truth[:, :3, :3], points - truth[:, None, :3, 3])
camera = Camera.from_parameters(500, 500, 320, 240, width=640, height=480)
pixels = np.asarray(camera.to_pixels(X[..., :2] / X[..., 2:])) + rng.normal(scale=0.3, size=(*X.shape[:2], 2))
visible = (pixels > 0).all(axis=-1) & (pixels < [640, 480]).all(axis=-1)

settings = Settings.of(camera, noise_px=0.3)
odometry = follow_tracks(camera, pixels, visible, settings=settings, record=True)
found = odometry.trajectory()
error = evaluate(found, Trajectory(found.times, truth))
print(f"ATE {error.ate_percent:.2f} % of the path, orientation {error.rotation_rmse_deg:.3f} degrees")
sd = error.scale * np.sqrt(np.trace(found.covariance[-1, :3, :3]))
print(f"the last position: one sigma {sd:.3f} after {error.scale * found.path_length:.2f}")
recording = odometry.recording()  # the same run as a pure function of what it was told


def loss(sigma):
    report = replay.tracks(camera, replace(settings, sigma=sigma), recording)
    return replay.negative_log_likelihood(camera, recording, report)


print(f"slope of the loss by log sigma: {settings.sigma * jax.jit(jax.grad(loss))(settings.sigma):.3f}")
