"""A run and its errors in words."""

from collections.abc import Iterable
from pathlib import Path

from jaxtri.odometry.calibrate import Calibration
from jaxtri.odometry.run import Run
from jaxtri.trajectory import Evaluation

SHOWN = 4  # of parts of the picture that are ignored, and of places that are seen again, so many are named
COUNTS = 0.25  # weight of a place from which it counts


def run_text(run: Run, paths: Iterable[Path]) -> str:
    """What a run gave, and the files that it is in."""
    s = run.statistics
    status = s["status"]
    assert isinstance(status, dict)
    states = ", ".join(f"{count} {name}" for name, count in status.items())
    points = f"{s['points_used_per_frame']:.0f} points a frame, {len(run.points.ids)} in all"
    lines = [
        f"{s['frames']} frames at {s['frames_per_second']:.0f} a second: {states}",
        f"{s['keyframes']} keyframes, {points}",
    ]
    doubts = s["doubts"]
    assert isinstance(doubts, dict)
    if doubts:
        frame, words = next(iter(doubts.items()))
        more = f", the first of {len(doubts)}" if len(doubts) > 1 else ""
        lines.append(f"frame {frame}{more}, is uncertain: {'; '.join(words)} (run.json has them all)")
    if run.calibration is not None:
        lines.append(_camera(run.calibration))
    lines += _ignored(s["ignored"])
    refined = s["refined"]
    if isinstance(refined, dict):
        seconds = s["seconds"]
        assert isinstance(seconds, dict)
        lines.append(
            f"refined by {refined['keyframes']} frames at once in {seconds['refinement']:.1f} s: moved by "
            f"{refined['moved_percent_of_path']:.2g} % of the path and {refined['turned_deg']:.2g} degrees"
        )
        lines += _loops(refined)
    lines += [f"lost, and found again in frame {again.frame}, at the scale of before" for again in run.odometry.found]
    if s["scale_unknown_from_frame"] is not None:
        lines.append(f"the camera was lost: from frame {s['scale_unknown_from_frame']} on the scale is a guess")
    if s["interrupted"]:
        lines.append("interrupted: these are the frames up to there")
    return "\n".join([*lines, *(f"  {path}" for path in paths)])


def _loops(refined: dict) -> list[str]:
    """A line on the places that were seen again and count; none where there are none."""
    counted = [loop for part in refined["parts"] for loop in part.get("loops", ()) if loop["weight"] > COUNTS]
    if not counted:
        return []
    frames = ", ".join(f"{loop['frame']} (of {loop['place']})" for loop in counted[:SHOWN])
    more = f" and {len(counted) - SHOWN} more" if len(counted) > SHOWN else ""
    return [f"places seen again in frame {frames}{more}"]


def _camera(found: Calibration) -> str:
    """A line on the camera that was estimated."""
    fx = float(found.camera.fx)
    said = f"focal length {fx:.5g} +- {fx * found.focal_sd:.2g} pixels ({found.field_of_view_deg:.3g} degrees across)"
    if found.radial_sd and found.camera.distortion is not None:
        radial = zip(("k1", "k2"), found.camera.distortion.coefficients.tolist(), found.radial_sd, strict=False)
        said += "".join(f", {name} {k:.3f} +- {sd:.2g}" for name, k, sd in radial)
    if found.zoom is not None:
        first, last = (fx * found.zoom.ratio[k] for k in (0, -1))
        said = f"the camera zooms, from {first:.5g} to {last:.5g} pixels; mean {said}"
    return f"{said}: {'from the video' if found.determined else 'NOT determined by this motion'}"


def _ignored(ignored: object) -> list[str]:
    """A line on the bars and overlays that were found; none where there are none."""
    assert isinstance(ignored, dict)
    found = ignored["found"]
    if not found:
        return []
    parts = [
        f"{part['kind']} at x {part['left']} to {part['right']}, y {part['top']} to {part['bottom']}, "
        f"frame {part['first']} to {'the end' if part['last'] is None else part['last']}"
        for part in found[:SHOWN]
    ]
    more = f"; and {len(found) - SHOWN} more (run.json has them all)" if len(found) > SHOWN else ""
    return [f"{ignored['share']:.1%} of the picture ignored: {'; '.join(parts)}{more}"]


def errors_text(found: Evaluation) -> str:
    """How far a trajectory is from another; lengths in units of the reference."""
    return (
        f"{found.matched} frames matched, {found.coverage:.1%} of the reference; scale {found.scale:.6g}\n"
        f"ATE  {found.ate_rmse:.6g} rmse, {found.ate_percent:.3f} % of the path\n"
        f"RPE  {found.rpe_translation:.6g} ({found.rpe_translation_percent:.2f} % of the mean step), "
        f"{found.rpe_rotation_deg:.4f} degrees a frame\n"
        f"orientation {found.rotation_rmse_deg:.4f} degrees rmse"
    )
