"""A run of a camera that is not calibrated: tracked and calibrated in turns."""

import warnings
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from copy import copy
from dataclasses import replace
from typing import Any

from jaxtri.errors import InitialisationError, InputWarning
from jaxtri.geometry.camera import Camera
from jaxtri.odometry.calibrate import GUESSED, calibrate
from jaxtri.odometry.run import Run, refined, track
from jaxtri.odometry.settings import Settings
from jaxtri.vision.video import Frame

ROUNDS = 3  # the second is with a camera that is nearly right; a third where the first guess was far off
WIDER, LONGER = 0.6, 2.2  # focal lengths over the first guess that are tried where no motion is found with that
TOLERATED = 0.05  # at most what the first round's covariances take the focal length to be off by, as a share of it


def track_uncalibrated(
    reopen: Callable[[], AbstractContextManager[Iterable[Frame]]],
    camera: Camera,
    *,
    prior: float = GUESSED,
    rounds: int = ROUNDS,
    settings: Callable[[Camera, float], Settings] | None = None,
    refine: bool = True,
    progress: bool = True,
    **how: Any,
) -> Run:
    """Recover the trajectory and the intrinsics: track, estimate them (`jaxtri.calibrate`), and track again.

    `reopen` opens the source once more in every round: `lambda: open_source("clip.mp4")`. `camera` is the first guess,
    say `Camera.from_fov(60, width, height)`, and `prior` what its focal length may be off by, as a share of it.
    `settings` makes those of a camera whose focal length is known to such a share; the other arguments are those of
    `track`. The intrinsics are `run.odometry.camera`, and `run.calibration` says how well they are known; where the
    motion does not determine the focal length an `InputWarning` says so. A focal length that changes on the way is
    followed: `run.odometry.zoom`. Where the last two rounds agree, `refine` takes what was found last; the causal poses
    are by that of the round before.

    An interrupt (Ctrl-C) ends the sequence there, for all rounds. Where a camera that was found shows no motion any
    more, the round before stands, and its focal length is off by as much. Raises what `track` raises;
    `InitialisationError` only where no motion is found with a shorter and a longer focal length either.
    """
    make = settings or (lambda camera, share: Settings.of(camera, calibration=share))
    guess, share, found, run, number, most = camera, min(prior, TOLERATED), None, None, 0, max(rounds, 2)
    interrupted, zoom = False, None
    for number in range(1, most + 1):
        try:
            run = _tracked(reopen, guess, make, share, progress, zoom=zoom, **how)
        except InitialisationError as error:
            if run is not None and found is not None:  # it is worse than the camera of the round before: that stands
                guess, zoom = run.odometry.camera, run.odometry.zoom
                off = max(found.focal_sd, found.shift(guess, zoom))
                found = replace(found, camera=guess, zoom=zoom, focal_sd=off)
                break
            run = _otherwise(error, reopen, guess, make, share, progress, **how)
            guess = run.odometry.camera
        if run.statistics["interrupted"]:  # the clip ends there, for the rounds to come, too
            interrupted, how = True, how | {"max_frames": len(run.poses)}
        found = calibrate(run.odometry, guess=camera, prior=prior, progress=progress)
        if number == most or (number > 1 and found.shift(guess, zoom) < found.focal_sd):
            break
        guess, share, zoom = found.camera, found.focal_sd, found.zoom
    assert run is not None
    assert found is not None
    apart = found.shift(guess, zoom)
    if refine and apart < found.focal_sd:  # all at once by what was found last: nearly what it was tracked with
        odometry = copy(run.odometry)
        odometry.camera, odometry.zoom = found.camera, found.zoom
        run = replace(run, odometry=odometry)
    else:  # by the one that it was tracked with, which is known to no more than they are apart
        found = replace(found, camera=guess, zoom=zoom, focal_sd=max(found.focal_sd, apart))
    if refine:
        run = refined(run, progress=progress)
    if not found.determined:
        warnings.warn(
            f"the focal length is {float(found.camera.fx):.0f} pixels, give or take {found.focal_sd:.0%}: the motion "
            "does not determine it; film with turns and with sideways motion before something near, or give what is "
            "known, --camera or --fov",
            InputWarning,
            stacklevel=2,
        )
    said = {"interrupted": interrupted, "calibration": found.statistics() | {"rounds": number}}
    return replace(run, calibration=found, statistics=run.statistics | said)


def _tracked(
    reopen: Callable[[], AbstractContextManager[Iterable[Frame]]],
    camera: Camera,
    make: Callable[[Camera, float], Settings],
    share: float,
    progress: bool,
    **how: Any,
) -> Run:
    with reopen() as source:
        return track(source, camera, settings=make(camera, share), record=True, progress=progress, **how)


def _otherwise(error: InitialisationError, reopen: Any, guess: Camera, *rest: Any, **how: Any) -> Run:
    """The run with another focal length; the first error where there is none with any."""
    for factor in (WIDER, LONGER):
        other = replace(guess, fx=guess.fx * factor, fy=guess.fy * factor)
        try:
            return _tracked(reopen, other, *rest, **how)
        except InitialisationError:
            continue
    raise error
