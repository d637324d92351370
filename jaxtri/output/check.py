"""What `jaxtri check` says of a source: its figures in words, what is wrong with it, and whether it can be tracked."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from jaxtri.output.words import ranges
from jaxtri.vision.survey import COMMON, FLOW, POINTS, Survey

# What is worth a word. In brackets what real sequences show that are tracked well.
FEW = 100  # median of the features (240 to 800; 20 are the least of a start, and not all of them agree)
LASTING = 0.6  # median survival of the features from frame to frame (.71 and more)
SLOW = 0.9  # median survival above which it is the motion that is too small: where it is, good features stay
DARK, BRIGHT = 0.1, 0.9  # mean brightness (.13 to .63)
FLICKER = 0.05  # `Survey.flicker` (up to .015)
FLAT = 3.5  # `Survey.depth` (4.5 and more; noise alone makes 2.5, a tripod with a zoom 2.8)
OFTEN = 0.05  # share of the frames from which combing and repeated frames count: one alone does no harm
LONG = 0.2  # share of the frames from which a stretch that stands still counts
UNSEEN = 1 / 3  # length of a dissolve before what is seen of it, over that: where the later shot has less than .2
LISTED = 6  # ranges of frames that are named


@dataclass(frozen=True)
class Finding:
    """Something that is wrong with a source.

    Attributes:
        seen: What was seen, in numbers.
        means: What that means for a run.
        remedy: What helps.
        frames: Numbers of the frames that show it; empty where all do.
        stops: Whether the source cannot be tracked at all for it.
    """

    seen: str
    means: str
    remedy: str
    frames: tuple[int, ...] = ()
    stops: bool = False

    def __str__(self) -> str:
        # The remedy has a line of its own: it may hold a command to be copied.
        return f"  {self.seen}: {self.means};\n    {self.remedy}"


def findings(found: Survey) -> list[Finding]:
    """What is wrong with a source, what stops a run first; empty where nothing is."""
    stops = _stops(found)
    return [*stops, *_film(found), *(() if stops else _features(found)), *_motion(found, bool(stops))]


def verdict(wrong: Iterable[Finding]) -> str:
    """Whether the source can be tracked: `can be tracked`, `can be tracked, but`, or `cannot be tracked`."""
    stops = [finding.stops for finding in wrong]
    return "cannot be tracked" if any(stops) else "can be tracked, but" if stops else "can be tracked"


def check_text(found: Survey, wrong: list[Finding]) -> str:
    """The figures of a source, a line each, and the verdict."""
    said = verdict(wrong)
    return "\n".join([*_facts(found), said + (":" if wrong else ""), *map(str, wrong)])


def _facts(s: Survey) -> list[str]:
    (w, h), t = s.size, len(s.index)
    declared = f" of {s.declared} declared" if s.declared not in (None, t) else ""
    shape = f", pixels {s.pixel_aspect:.3g} times as wide as high" if s.pixel_aspect != 1 else ""
    turned = f", turned by {s.turned_deg} degrees" if s.turned_deg else ""
    flow = f"{_median(s.flow_px):.3g} pixels a frame, {_median(s.flow_px) / w:.2%} of the width"
    most = f" (at most {np.nanmax(s.flow_px):.3g}, frame {np.nanargmax(s.flow_px)})" if _any(s.flow_px) else ""
    frames = {
        "repeated": s.repeated,
        "still": s.still,
        "blurred": s.blurred,
        "combed": s.combed,
        "cuts": s.cuts,
        "jumps": s.jumps,
        "dissolves": s.dissolves,
    }
    return [
        f"{s.name}: {w}x{h} pixels{shape}{turned}",
        f"frames       {t}{declared}, {s.seconds:.3g} s; {_times(s)}",
        f"exposure     mean {s.brightness.mean():.0%} of white, clipped {s.black.mean():.1%} black and "
        f"{s.white.mean():.1%} white, flicker {s.flicker:.1%}",
        f"blur         {np.median(s.blur):.2f} of 1, from {s.blur.min():.2f} to {s.blur.max():.2f}",
        f"features     {np.median(s.features):.0f} in a frame; {_median(s.survival):.0%} of them are followed into the "
        f"next, half are lost within {s.life:.0f} frame{'s' if s.life != 1 else ''}",
        f"flow         {flow}{most}",
        "frames that  " + "; ".join(f"{name}: {ranges(m, LISTED) or 'none'}" for name, m in frames.items()),
    ]


def _times(s: Survey) -> str:
    steps = np.diff(s.time_s)
    if not s.timed or not len(steps):
        return f"times are assumed ({s.fps:g} a second)" if s.fps else "times are not known"
    low, middle, high = np.quantile(steps, [0.02, 0.5, 0.98])
    rate = f"{1 / middle:.4g} a second"
    # Stamps in whole milliseconds differ by one of 33 or less.
    return f"{rate}, from {low:.3g} to {high:.3g} s apart" if high - low > 0.1 * middle else f"{rate}, evenly"


def _stops(s: Survey) -> list[Finding]:
    """Why no start can be found, as `jaxtri.odometry.start` would say it."""
    if len(s.index) < 2:
        return [Finding("there is 1 frame", "a camera's motion needs at least two", "give a longer clip", stops=True)]
    if s.startable:
        return []
    features, reached = float(np.median(s.features)), float(np.nanmax(s.start_flow)) if _any(s.start_flow) else 0.0
    if features < POINTS:
        seen = f"{features:.0f} features in a frame (median), {POINTS} are needed{_causes(s)}"
        return [Finding(seen, "there is too little to follow", _light(s), stops=True)]
    if _median(s.survival) > SLOW:
        seen = f"the picture moves by {reached:.2%} of its width at most, {FLOW:.1%} are needed"
        means = "the camera stands still or moves slowly"
        return [Finding(seen, means, "give a longer clip, in which the camera moves sideways", stops=True)]
    seen = f"{_median(s.survival):.0%} of the features are followed into the next frame (median){_causes(s)}"
    means = f"less than {COMMON:.0%} of a frame's are left before the picture has moved by {FLOW:.1%} of its width"
    remedy = f"give frames that follow each other more closely, or {_light(s)}"
    if s.combed.mean() > OFTEN or s.flicker > FLICKER:
        remedy = "mend first what is named below"
    return [Finding(seen, means, remedy, stops=True)]


def _film(s: Survey) -> list[Finding]:
    """What is wrong with the film itself."""
    found, t = [], len(s.index)
    if s.cuts.any():
        at = int(np.flatnonzero(s.cuts)[0])
        means = "the clip has several shots, which no single path joins"
        remedy = "give each shot by itself" + (f" (--max-frames {at} tracks the first)" if at > 1 else "")
        found.append(_finding(s.cuts, "begins another shot", "begin another shot", means, remedy))
    if s.dissolves.any():
        begin, end = _first_run(s.dissolves)
        at = begin - round(UNSEEN * (end - begin))
        means = "each is a mixture of an earlier and a later picture, and no single path joins two shots"
        remedy = "look there; if it is so, give each shot by itself"
        remedy += f" (--max-frames {at} tracks the first)" if at > 1 else ""
        found.append(_finding(s.dissolves, "seems to dissolve", "seem to dissolve into another shot", means, remedy))
    if s.combed.mean() > OFTEN:
        means = "even and odd rows were taken at two moments: the film is interlaced"
        remedy = f"deinterlace {'the film of these images' if s.folder else 'it'}: ffmpeg -i FILE -vf yadif new.mp4"
        found.append(_finding(s.combed, "is combed", "are combed", means, remedy))
    if s.repeated.mean() > OFTEN:
        means = f"{int(s.repeated.sum())} of {t} show the one before again, and the camera seems to stop and go"
        remedy = (
            "leave out these images, and their times"
            if s.folder
            else "ffmpeg -i FILE -vf mpdecimate new.mp4 leaves them out"
        )
        found.append(_finding(s.repeated, "is a repetition", "are repetitions", means, remedy))
    if s.flicker > FLICKER:
        means = "features are lost where the same thing changes its brightness"
        remedy = "film with a fixed exposure of 1/50 s or 1/60 s, as the mains have it"
        found.append(Finding(f"the brightness changes by {s.flicker:.0%} to and fro between frames", means, remedy))
    if s.blurred.any():
        remedy = "film with a shorter exposure or more light"
        means = f"the blur is {s.blur[s.blurred].max():.2f} of 1 there, and features are less exact or lost"
        found.append(_finding(s.blurred, "is blurred", "are blurred", means, remedy))
    return found


def _features(s: Survey) -> list[Finding]:
    """What makes a start or the frames after it worse than they could be."""
    found, features = [], float(np.median(s.features))
    bare = s.features < POINTS
    if bare.any():
        means = f"fewer than {POINTS} features are seen, and the camera is lost if that lasts"
        found.append(_finding(bare, "is bare", "are bare", means, "cut the clip there"))
    if features < FEW:
        seen = f"{features:.0f} features in a frame (median){_causes(s)}"
        found.append(Finding(seen, "poses will be uncertain", _light(s)))
    elif _median(s.survival) < LASTING:
        seen = f"{_median(s.survival):.0%} of the features are followed into the next frame (median){_causes(s)}"
        remedy = f"give frames that follow each other more closely, or {_light(s)}"
        found.append(Finding(seen, "tracks are too short to measure well", remedy))
    elif exposed := _exposed(s):
        found.append(Finding(exposed, "features are less exact, and fewer last", _light(s)))
    return found


def _motion(s: Survey, stopped: bool) -> list[Finding]:
    """What is wrong with how the camera moves."""
    found = []
    if s.jumps.any():
        low = float(np.nanmin(s.survival[s.jumps]))
        means = (
            f"only {low:.0%} of the features are followed there; frames are missing, or a blur, a flash or a jerk is"
        )
        remedy = "give the missing frames, or cut the clip there if the camera is lost"
        found.append(_finding(s.jumps, "comes after a jump", "come after a jump", means, remedy))
    if s.still.mean() > LONG and not stopped:
        means = "the camera stands still there, and nothing is learned of the scene"
        remedy = "cut off what stands still at the beginning; elsewhere it does no harm"
        found.append(_finding(s.still, "stands still", "stand still", means, remedy))
    if _any(s.depth) and _median(s.depth) < FLAT:
        seen = (
            f"one homography explains the flow nearly as well as a motion in depth ({_median(s.depth):.1f} times worse)"
        )
        means = "the camera only turns or zooms, which shows no path, or the scene is flat"
        found.append(Finding(seen, means, "film with sideways motion before things near and far"))
    return found


def _finding(mask: Bool[np.ndarray, " t"], one: str, many: str, means: str, remedy: str) -> Finding:
    at = np.flatnonzero(mask)
    seen = f"frame {at[0]} {one}" if len(at) == 1 else f"frames {ranges(mask, LISTED)} {many}"
    return Finding(seen, means, remedy, tuple(int(k) for k in at))


def _first_run(mask: Bool[np.ndarray, " t"]) -> tuple[int, int]:
    at = np.flatnonzero(mask)
    return int(at[0]), int(at[0]) + int(np.argmin(np.append(mask[at[0] :], False)))


def _exposed(s: Survey) -> str:
    mean = float(np.median(s.brightness))
    how = "dark" if mean < DARK else "too bright" if mean > BRIGHT else ""
    clipped = f"clipped {s.black.mean():.1%} black and {s.white.mean():.1%} white"
    return f"it is {how} (mean {mean:.1%} of white, {clipped})" if how else ""


def _causes(s: Survey) -> str:
    """What the pictures have that makes features few or short-lived; empty where nothing stands out."""
    causes = [_exposed(s), "it is blurred" if s.blurred.mean() > 0.5 else ""]
    return "".join(f", and {cause}" for cause in causes if cause)


def _light(s: Survey) -> str:
    bright = float(np.median(s.brightness)) > BRIGHT
    return "film with a shorter exposure" if bright else "film with more light, before something with texture"


def _median(x: np.ndarray) -> float:
    return float(np.nanmedian(x)) if _any(x) else 0.0


def _any(x: np.ndarray) -> bool:
    return bool(np.isfinite(x).any())
