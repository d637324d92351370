"""The focal length and the lens of a camera from its own video: keyframes, points and intrinsics at once."""

import math
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxtri.errors import InputError
from jaxtri.estimation import batch, calibration
from jaxtri.estimation.batch import Estimate
from jaxtri.geometry.camera import Camera
from jaxtri.odometry.adjustment import FEWEST, Adjustment, stretch
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.stretches import Pieces, Segment, segments

# What is known beforehand: of the focal length, as a share of it, where it is a guess of what most cameras have (24 to
# 110 degrees are within one standard deviation of 60); of the principal point, as a share of the width; of k1 and k2.
GUESSED, CENTRE, LENS = 0.5, 0.02, (0.2, 0.1)
# The least that is said of the focal length's standard deviation, as a share of it. Real video is not what the model
# says (rolling shutter, a lens of more coefficients, features that drift together), and no scatter of the tracks shows
# that: on the six sequences of `benchmarks/real_sequences.py` it is 1.5 % and more that the estimates are off by.
UNMODELLED = 0.015
UNDETERMINED = 0.1  # share of the focal length: with a larger standard deviation the motion does not determine it
MOST, ALONE = 20, 8  # changes of the intrinsics, and at most of the focal length alone; five to ten are usual
STEPS, FIRST = 4, 20  # of the poses and points after each change, and before the first
LARGEST = (0.25, 0.02, 0.02, 0.1, 0.05)  # change of each at once: so far is the slope still good
SETTLED = 0.1  # standard deviations, below which a change is none
TIMES, CELLS = 10, 3  # parts of the sequence, and of each side of the picture, that may err each in its own way


@dataclass
class Calibration:
    """Intrinsics of a camera, from its own video.

    Attributes:
        camera: The camera: with its focal length, principal point and, where the lens is Brown's or none was known, k1
            and k2.
        focal_sd: Standard deviation of the focal length, as a share of it.
        centre_sd: Standard deviations of the principal point, pixels.
        radial_sd: Standard deviations of k1 and k2; empty for another lens.
        keyframes: Number of the frames that it comes from.
    """

    camera: Camera
    focal_sd: float
    centre_sd: tuple[float, float]
    radial_sd: tuple[float, ...]
    keyframes: int

    @property
    def determined(self) -> bool:
        """Whether the motion determines the focal length: to better than a tenth."""
        return self.focal_sd < UNDETERMINED

    @property
    def field_of_view_deg(self) -> float:
        """From the left edge of the picture to the right one, as a pinhole has it, degrees."""
        width = self.camera.width or 2 * float(self.camera.cx) + 1
        return 2 * math.degrees(math.atan(width / (2 * float(self.camera.fx))))

    def statistics(self) -> dict[str, object]:
        """As `run.json` has them."""
        fx, lens = float(self.camera.fx), self.camera.distortion
        said: dict[str, object] = {
            "focal_length_px": round(fx, 3),
            "focal_length_sd_px": round(fx * self.focal_sd, 3),
            "field_of_view_deg": round(self.field_of_view_deg, 3),
            "principal_point_px": [round(float(c), 3) for c in (self.camera.cx, self.camera.cy)],
            "principal_point_sd_px": [round(s, 3) for s in self.centre_sd],
            "determined": self.determined,
            "keyframes": self.keyframes,
        }
        if self.radial_sd and lens is not None:
            said["k1_k2"] = [round(float(c), 5) for c in lens.coefficients[: len(self.radial_sd)]]
            said["k1_k2_sd"] = [round(s, 5) for s in self.radial_sd]
        return said

    def shift(self, other: Camera) -> float:
        """How far another camera sees what this one sees at the corner of its picture, as a share of the way there.

        By its focal length and its lens: a principal point that moves is, nearly, a camera that turns.
        """
        c = self.camera
        corner = jnp.asarray([c.width or 2 * c.cx, c.height or 2 * c.cy], c.fx.dtype)
        ray, centre = c.to_normalised(corner), jnp.stack([c.cx, c.cy])
        seen = replace(other, cx=c.cx, cy=c.cy).to_pixels(ray)
        moved = jnp.linalg.norm(seen - corner) / jnp.linalg.norm(corner - centre)
        return max(float(moved), abs(math.log(float(other.fx / c.fx))))


def calibrate(
    odometry: Odometry, *, guess: Camera | None = None, prior: float = GUESSED, progress: bool = False
) -> Calibration:
    """Estimate the intrinsics from a run: `Odometry(..., record=True)`, or `run.odometry` of `track(..., record=True)`.

    Of the longest stretch over which the camera was followed. `guess` is what was thought of the camera before anything
    was seen, by default `odometry.camera`, and `prior` the standard deviation of its focal length, as a share of it;
    that of the principal point is 2 % of the width, that of k1 and k2 .2 and .1.

    Standard deviations are the largest of those by the noise that is assumed and by what tracks, times and parts of the
    picture disagree on (White 1980). Those of the focal length and the principal point count 1.5 % of the focal length,
    which no track shows.

    The poses were followed with the camera as it was. Where it has changed much, track again with the new one, and
    estimate once more: `track_uncalibrated` does. Raises `InputError` where no tracks were kept,
    `InitialisationError` where there is no pose.
    """
    if not odometry.record:
        raise InputError("nothing was recorded: ask for it by record=True")
    odometry.trajectory()  # takes in what is queued, and raises where there is none
    first, end = max(segments(odometry), key=lambda s: s[1] - s[0])
    segment, keys, settings, _ = stretch(odometry, first, end)
    camera = calibration.with_lens(odometry.camera)
    about = calibration.difference(camera, camera if guess is None else calibration.with_lens(guess))
    centre = CENTRE * (camera.width or 2 * float(camera.cx)) / float(camera.fx)
    known = np.array([prior, centre, centre, *LENS])[: len(about)]
    if len(keys) < FEWEST:
        return _found(camera, known, len(keys))
    search = _Search(odometry, camera, (first, end), segment, keys, Adjustment.of(settings, segment, keys))
    change, sd = search.run(np.asarray(about), known, progress)
    if not (np.isfinite(change).all() and np.isfinite(sd).all()):
        change, sd = np.zeros_like(known), known
    return _found(calibration.changed(camera, jnp.asarray(change)), sd, len(keys))


def _found(camera: Camera, sd: np.ndarray, keyframes: int) -> Calibration:
    focal_sd, cx, cy = (math.hypot(s, UNMODELLED) for s in sd[:3])
    centre_sd = cx * float(camera.fx), cy * float(camera.fy)
    return Calibration(camera, focal_sd, centre_sd, tuple(float(s) for s in sd[3:]), keyframes)


@dataclass
class _Search:
    """Changes of the intrinsics and of all that was seen by them, in turns."""

    odometry: Odometry
    camera: Camera  # to begin with, with a lens
    frames: tuple[int, int]
    segment: Segment
    keys: np.ndarray
    begun: Adjustment

    def run(self, about: np.ndarray, known: np.ndarray, progress: bool) -> tuple[np.ndarray, np.ndarray]:
        """The change of the intrinsics, and its standard deviations.

        Beforehand it is `about` so much, with a standard deviation of `known`.
        """
        by, now, told, inverse = np.zeros_like(known), self.begun.estimate, None, np.diag(known**2)
        problem, noise, free = self.begun.problem, self.begun.noise, 1
        for number in tqdm(range(MOST), unit="step", desc="calibrate", disable=None if progress else True, leave=False):
            camera = calibration.changed(self.camera, jnp.asarray(by))
            if number:
                problem = self._seen(camera)
                noise = noise._replace(sigma=self.begun.noise.sigma * self.camera.focal / camera.focal)
            now = Estimate.of(now.poses, now.points)
            for _ in range(STEPS if number else FIRST):
                now = batch.step(problem, noise, now)
                if bool(now.done):
                    break
            told = calibration.told(problem, noise, now.poses, now.points, camera)
            information = np.asarray(told.information) + np.diag(known**-2)
            pull = np.asarray(told.pull) - (by - about) * known**-2
            if not (np.isfinite(information).all() and np.isfinite(pull).all()):
                return pull * np.nan, known
            # The focal length first: far from it a lens is found that explains what is wrong with it, and stays.
            inverse, step = np.linalg.inv(information), np.zeros_like(pull)
            step[:free] = np.linalg.solve(information[:free, :free], pull[:free])
            settled = (np.abs(step) < SETTLED * np.sqrt(np.maximum(np.diag(inverse), 0))).all()
            if settled and free == len(step):
                break
            if settled or number + 1 == ALONE:
                free = len(step)
            most = np.array(LARGEST[: len(step)])
            step = np.clip(step, -most, most)
            by = by + step
            now = now._replace(poses=batch.moved_poses(problem, now.poses, told.response @ jnp.asarray(step)))
        assert told is not None
        return by, self._sd(inverse, [np.asarray(s) for s in told.scores])

    def _seen(self, camera: Camera) -> batch.Batch:
        """All that was seen, as the camera sees it; what it has no ray for is left out."""
        seen = Segment.of(self.odometry, *self.frames, camera)
        u = np.where((self.segment.seen & ~seen.seen)[..., None], np.nan, seen.u)
        layers = []
        pieces = Pieces.of(self.segment._replace(u=u), self.keys)
        for layer, (observed, mask, *_) in zip(self.begun.problem.layers, pieces.layers, strict=True):
            mask = mask & np.isfinite(observed).all(axis=1)
            layers.append(layer._replace(observed=jnp.asarray(np.nan_to_num(observed)), mask=jnp.asarray(mask)))
        return self.begun.problem._replace(layers=tuple(layers))

    def _sd(self, inverse: np.ndarray, scores: list[np.ndarray]) -> np.ndarray:
        """Standard deviations (p,) by what was assumed, and by how groups of tracks disagree: the larger of them."""
        pieces = self.begun.pieces
        score = pieces.each(scores, (len(inverse),))
        count = np.bincount(pieces.piece)
        at = self.odometry.tracks[self.frames[0]].pixels  # the size of the picture, where it is not known
        camera = self.camera
        size = np.array([camera.width or at[:, 0].max(), camera.height or at[:, 1].max()])
        frames = self.frames[0] + self.keys[pieces.key]
        pixels = np.array([self.odometry.tracks[f].pixels[s] for f, s in zip(frames, pieces.slot, strict=True)])
        mean = np.stack([np.bincount(pieces.piece, pixels[:, i] / size[i]) / count for i in (0, 1)])
        column, row = (mean * CELLS).astype(int).clip(0, CELLS - 1)
        middle = np.bincount(pieces.piece, pieces.key) / count
        found = [np.diag(inverse)]
        for group in (pieces.ids, (middle * TIMES / len(self.keys)).astype(int), row * CELLS + column):
            group = np.unique(group, return_inverse=True)[1]
            groups = group.max() + 1
            together = np.stack([np.bincount(group, s) for s in score.T])
            found.append(np.diag(inverse @ (together @ together.T * groups / max(groups - 1, 1)) @ inverse))
        return np.sqrt(np.maximum(np.max(found, axis=0), 0))
