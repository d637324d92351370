"""How the trajectory's error depends on the calibration: its gradient by focal length and lens distortion."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from jaxtri import BrownConrady, Camera, Settings, ate_rmse, follow_tracks, replay
from jaxtri.synthetic import steady_experiment

jax.config.update("jax_enable_x64", True)

# Points that a camera goes around, seen through a lens with a barrel distortion.
truth = steady_experiment(jax.random.key(0), orbit=True, degrees_per_frame=(0.3, 1.5, 0.0), n_points=60, n_frames=30)
lens = BrownConrady.from_coefficients([-0.1])
camera = Camera.from_parameters(600, 600, 320, 240, width=640, height=480, distortion=lens)
pixels = camera.to_pixels(truth.observed)
recording = follow_tracks(camera, pixels, jnp.ones(pixels.shape[:2], bool), record=True).recording()
centres = -jnp.einsum("tji,tj->ti", truth.rotations, truth.translations)[1 + int(recording.origin) :]


def ate(told):
    coefficients = camera.distortion.coefficients.at[0].set(told["k1"])
    wrong = replace(camera, fx=told["focal"], fy=told["focal"], distortion=BrownConrady(coefficients))
    report = replay.tracks(wrong, Settings.of(wrong), recording)
    return 1000 * ate_rmse(report.pose.inverse().translation(), centres)


value_and_slope = jax.jit(jax.value_and_grad(ate))
told = {"focal": jnp.asarray(612.0), "k1": jnp.asarray(-0.08)}
value, slope = value_and_slope(told)
print(f"ATE {value:.3f} mm with a focal length of 612 instead of 600 pixels and k1 of -0.08 instead of -0.1")
for name, h in (("focal", 1e-3), ("k1", 1e-6)):
    (more, _), (less, _) = (value_and_slope(told | {name: told[name] + x}) for x in (h, -h))
    print(f"by {name}: {slope[name]:.5g}, by differences {(more - less) / (2 * h):.5g}")
