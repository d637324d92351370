"""How the trajectory's error depends on the calibration: its gradient by focal length and lens distortion."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from jaxtri import BrownConrady, Camera, Settings, ate_rmse, follow_tracks, replay
from jaxtri.synthetic import paper_experiment

jax.config.update("jax_enable_x64", True)

# Points before a camera that moves and turns, as seen through a lens with a barrel distortion.
truth = paper_experiment(jax.random.key(0), n_points=60, n_frames=30, phases=(2,))
lens = BrownConrady.from_coefficients([-0.1])
camera = Camera.from_parameters(600, 600, 320, 240, width=640, height=480, distortion=lens)
pixels = camera.to_pixels(truth.observed)
visible = ((pixels > 0) & (pixels < jnp.array([640, 480]))).all(axis=-1)
recording = follow_tracks(camera, pixels, visible, record=True).recording()
centres = -jnp.einsum("tji,tj->ti", truth.rotations, truth.translations)[1 + int(recording.origin) :]


def ate(told):
    coefficients = camera.distortion.coefficients.at[0].set(told["k1"])
    wrong = replace(camera, fx=told["focal"], fy=told["focal"], distortion=BrownConrady(coefficients))
    report = replay.tracks(wrong, Settings.of(wrong), recording)
    return 1000 * ate_rmse(report.pose.inverse().translation(), centres)


value_and_slope = jax.jit(jax.value_and_grad(ate))
told = {"focal": jnp.array([606.0])[0], "k1": jnp.array([-0.08])[0]}
value, slope = value_and_slope(told)
print(f"ATE {value:.3f} mm with a focal length of 606 instead of 600 pixels and k1 of -0.08 instead of -0.1")
for name, h in (("focal", 1e-3), ("k1", 1e-6)):
    (more, _), (less, _) = (value_and_slope(told | {name: told[name] + x}) for x in (h, -h))
    print(f"by {name}: {slope[name]:.5g}, by differences {(more - less) / (2 * h):.5g}")
