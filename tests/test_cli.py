import json
import subprocess
import sys
import types
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest

from jaxtri.cli import main
from jaxtri.cli.options import Track
from jaxtri.formats import read_camera, read_tum
from jaxtri.synthetic.rendered import write_laboratory
from jaxtri.trajectory import evaluate
from jaxtri.vision.video import write_video

DATA = Path(__file__).parents[2] / "shared" / "data"
FILES = ("trajectory.txt", "trajectory_causal.txt", "trajectory.png", "points.ply", "run.json", "overlay.mp4")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    folder = tmp_path_factory.mktemp("laboratory")
    write_laboratory(folder, 24, progress=False)
    return folder


@pytest.fixture(autouse=True)
def _same_precision():
    yield
    jax.config.update("jax_enable_x64", True)


def fails(arguments, capsys) -> str:
    """The one-line message of a command that must end with exit code 2."""
    with pytest.raises(SystemExit) as stop:
        main([str(a) for a in arguments])
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert "Traceback" not in message
    return message


def test_track_writes_everything_and_evaluate_reads_it(sequence, tmp_path, capsys):
    out = tmp_path / "out"
    main(["track", str(sequence), "--camera", str(sequence / "camera.json"), "--out", str(out), "--quiet"])
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)
    estimate, truth = read_tum(out / "trajectory.txt"), read_tum(sequence / "groundtruth.txt")
    np.testing.assert_allclose(estimate.times, truth.times, atol=1e-6)
    run = json.loads((out / "run.json").read_text())
    assert run["statistics"]["status"] == {"tracking": 24}
    assert run["settings"]["noise_px"] == 0.4
    assert run["settings"]["starts"] == "opencv"
    assert "jax" in run["versions"]
    assert run["statistics"]["refined"]["parts"][0]["refined"]
    assert run["statistics"]["refined"]["moved_percent_of_path"] < 0.5
    causal = read_tum(out / "trajectory_causal.txt")
    assert evaluate(estimate, truth).ate_percent < 0.1
    assert 0 < np.abs(causal.positions - estimate.positions).max() < 0.01
    video = cv2.VideoCapture(str(out / "overlay.mp4"))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 24
    capsys.readouterr()
    main(["evaluate", str(out / "trajectory.txt"), str(sequence / "groundtruth.txt"), "--json", str(out / "e.json")])
    assert "24 frames matched" in capsys.readouterr().out
    errors = json.loads((out / "e.json").read_text())
    assert errors["ate_percent"] < 0.5
    assert errors["rotation_rmse_deg"] < 0.1


def test_a_camera_that_is_not_known_is_found_and_can_be_given_back(sequence, tmp_path, capsys):
    out, again = tmp_path / "out", tmp_path / "again"
    main(["track", str(sequence), "--out", str(out), "--no-overlay", "--quiet"])
    said = capsys.readouterr()
    assert "focal length" in said.out
    statistics = json.loads((out / "run.json").read_text())["statistics"]["calibration"]
    found, true = read_camera(out / "camera.json"), read_camera(sequence / "camera.json")
    # The camera slides sideways: that its focal length is hardly seen is said, and the error is of that size.
    assert abs(np.log(float(found.fx / true.fx))) < 3 * statistics["focal_length_sd_px"] / float(found.fx)
    assert statistics["determined"] == ("does not determine it" not in said.err)
    assert statistics["rounds"] in (2, 3)
    refused = fails(["track", sequence, "--camera", out / "camera.json", "--refine-camera", "--out", out], capsys)
    assert "overwrite" in refused
    main(["track", str(sequence), "--camera", str(out / "camera.json"), "--out", str(again), "--no-overlay", "--quiet"])
    assert not (again / "camera.json").exists()
    estimate, truth = read_tum(again / "trajectory.txt"), read_tum(sequence / "groundtruth.txt")
    assert evaluate(estimate, truth).ate_percent < 1


def test_starts_by_poselib_are_in_the_record(sequence, tmp_path, monkeypatch):
    """With a stand-in for PoseLib that finds nothing, so that the extra need not be there."""
    nothing = types.SimpleNamespace(R=np.full((3, 3), np.nan), t=np.zeros(3))
    asked = []

    def estimate(*arguments):
        asked.append(arguments)
        return nothing, {}

    monkeypatch.setitem(sys.modules, "poselib", types.SimpleNamespace(estimate_relative_pose=estimate))
    options = ["--camera", str(sequence / "camera.json"), "--out", str(tmp_path), "--quiet", "--no-overlay"]
    main(["track", str(sequence), *options, "--starts", "poselib"])
    assert asked
    assert json.loads((tmp_path / "run.json").read_text())["settings"]["starts"] == "poselib"


def test_a_video_file_with_a_field_of_view_and_a_place(sequence, tmp_path, capsys):
    images = [cv2.imread(str(p)) for p in sorted((sequence / "frames").iterdir())]
    clip, out = tmp_path / "clip.mp4", tmp_path / "out"
    write_video(clip, images, 25.0)
    fov = str(np.rad2deg(2 * np.arctan(320 / 560)))
    main(["track", str(clip), "--fov", fov, "--out", str(out), "--quiet", "--place", "400", "380"])
    assert read_tum(out / "trajectory.txt").times[1] == pytest.approx(0.04)
    # A field of view is a guess, and the covariances count it as one.
    exact = ["--fov", fov, "--calibration-error", "0", "--out", str(tmp_path / "exact"), "--quiet", "--no-overlay"]
    main(["track", str(clip), *exact])
    runs = [json.loads((folder / "run.json").read_text()) for folder in (out, tmp_path / "exact")]
    guessed, known = (max(run["statistics"]["evidence_of_frame"]["position_sd"][-5:]) for run in runs)
    assert guessed > known
    capsys.readouterr()
    outside = ["track", clip, "--fov", fov, "--out", out, "--quiet", "--place", "4000", "380"]
    assert "outside the image" in fails(outside, capsys)


def test_wrong_input_ends_with_a_message_and_exit_code_2(sequence, tmp_path, capsys):
    camera, out = sequence / "camera.json", ["--out", tmp_path / "out", "--quiet"]

    def track(source, *options):
        return fails(["track", source, *(options or ("--camera", camera)), *out], capsys)

    assert "no such file" in track(tmp_path / "nothing.mp4")
    (tmp_path / "text.mp4").write_text("not a video")
    assert "text.mp4" in track(tmp_path / "text.mp4")
    (tmp_path / "empty").mkdir()
    assert "no image" in track(tmp_path / "empty").lower()
    assert "give one of them" in track(sequence, "--camera", camera, "--fov", "60")
    assert "fov" in track(sequence, "--fov", "190").lower()
    assert "choose one of" in track(sequence, "--camera", camera, "--base", "none")
    assert "at least two" in track(sequence, "--camera", camera, "--max-frames", "1")
    wrong = ("--features", "-5"), ("--noise-px", "nan"), ("--overlap", "0"), ("--max-frames", "0")
    for option, value in (*wrong, ("--calibration-error", "-1")):
        assert option in track(sequence, "--camera", camera, option, value)
    for name, value in (("fx", None), ("fx", -560.0), ("cy", float("inf")), ("model", "pushbroom")):
        entries = json.loads(camera.read_text())
        if value is None:
            del entries[name]
        else:
            entries[name] = value
        (tmp_path / "bad.json").write_text(json.dumps(entries))
        assert name in track(sequence, "--camera", tmp_path / "bad.json") or str(value) in track(
            sequence, "--camera", tmp_path / "bad.json"
        )
    (tmp_path / "words.yaml").write_text("a calibration\nof: [another, kind\n")
    assert "parsed as YAML" in track(sequence, "--camera", tmp_path / "words.yaml")
    file = tmp_path / "file"
    file.touch()
    assert "--out" in fails(["track", sequence, "--camera", camera, "--out", file, "--quiet"], capsys)
    entries = json.loads(camera.read_text()) | {"width": 320, "height": 240}
    (tmp_path / "small.json").write_text(json.dumps(entries))
    assert "--scale-camera" in track(sequence, "--camera", tmp_path / "small.json")
    small = json.loads(camera.read_text()) | {"width": 640, "height": 640}
    (tmp_path / "small.json").write_text(json.dumps(small))
    assert "another aspect" in track(sequence, "--camera", tmp_path / "small.json", "--scale-camera")
    for change in (["--turn-camera", "45"], ["--scale-camera"]):
        assert "give --camera FILE" in track(sequence, "--fov", "60", *change)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["blank", "static", "one frame"])
def test_sequences_without_motion_say_so(kind, sequence, tmp_path, capsys):
    image = cv2.imread(str(sequence / "frames" / "000000.jpg"))
    image = np.full_like(image, 120) if kind == "blank" else image
    frames = tmp_path / "frames"
    frames.mkdir()
    for k in range(1 if kind == "one frame" else 6):
        cv2.imwrite(str(frames / f"{k}.png"), image)
    message = fails(
        ["track", frames, "--camera", sequence / "camera.json", "--out", tmp_path / "out", "--quiet"], capsys
    )
    assert {"blank": "features", "static": "flow", "one frame": "at least two"}[kind] in message
    assert not (tmp_path / "out").exists()


def test_results_neither_overwrite_the_source_nor_count_as_its_frames(sequence, tmp_path, capsys):
    camera = ["--camera", sequence / "camera.json", "--quiet"]
    for source, out in ((sequence, sequence), (sequence, sequence / "frames"), (sequence / "frames",) * 2):
        message = fails(["track", source, *camera, "--out", out], capsys)
        assert "--out" in message
        assert "frames of the source" in message
    clip = tmp_path / "overlay.mp4"
    write_video(clip, [cv2.imread(str(p)) for p in sorted((sequence / "frames").iterdir())[:8]], 25.0)
    before = clip.read_bytes()
    (tmp_path / "linked").symlink_to(tmp_path)
    assert "overwrite" in fails(["track", clip, *camera, "--out", tmp_path / "linked"], capsys)
    assert clip.read_bytes() == before
    copy = tmp_path / "run.json"
    copy.write_bytes((sequence / "camera.json").read_bytes())
    assert "overwrite" in fails(["track", sequence, "--camera", copy, "--out", tmp_path], capsys)
    assert sorted(p.name for p in sequence.iterdir()) == ["camera.json", "frames", "groundtruth.txt", "timestamps.txt"]


def test_a_truncated_video_warns_and_fails_with_strict(sequence, tmp_path, capsys):
    images = [cv2.imread(str(p)) for p in sorted((sequence / "frames").iterdir())]
    clip = tmp_path / "clip.avi"
    write_video(clip, images, 25.0)
    clip.write_bytes(clip.read_bytes()[: int(0.8 * clip.stat().st_size)])
    options = ["--camera", str(sequence / "camera.json"), "--out", str(tmp_path / "out"), "--quiet", "--no-overlay"]
    main(["track", str(clip), *options])
    assert "of 24 declared" in capsys.readouterr().err
    assert "of 24 declared" in fails(["track", clip, *options, "--strict"], capsys)


def test_a_change_of_resolution_names_the_frame(sequence, tmp_path, capsys):
    for k, path in enumerate(sorted((sequence / "frames").iterdir())[:8]):
        image = cv2.imread(str(path))
        cv2.imwrite(str(tmp_path / f"{k}.png"), image if k < 5 else image[::2, ::2])
    out = tmp_path / "out"
    message = fails(["track", tmp_path, "--camera", sequence / "camera.json", "--out", out, "--quiet"], capsys)
    assert "frame 5" in message
    assert "320x240" in message


def test_evaluate_names_what_is_wrong(tmp_path, capsys):
    (tmp_path / "a.txt").write_text("0 1 2 3 0 0 0 1\n1 1 2 three 0 0 0 1\n")
    assert "2" in fails(["evaluate", tmp_path / "a.txt", tmp_path / "a.txt"], capsys)
    assert "nothing.txt" in fails(["evaluate", tmp_path / "nothing.txt", tmp_path / "a.txt"], capsys)


def test_the_installed_command_has_help():
    done = subprocess.run([sys.executable, "-m", "jaxtri.cli", "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert {"track", "evaluate", "demo"} <= set(
        done.stdout.replace(",", " ").replace("{", " ").replace("}", " ").split()
    )


def test_the_help_of_track_fits_on_a_screen_and_settings_are_flat(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit) as stop:
        main(["track", "--help"])
    assert stop.value.code == 0
    said = capsys.readouterr().out
    assert len(said.splitlines()) <= 55
    names = set(Track("a").flat()) - {"source"}
    assert {"camera", "fov", "noise_px", "base", "refine", "place", "strict"} <= names
    names = {name.replace("_", "-") for name in names}
    assert all(f"--{name} " in said or f"--no-{name} " in said or f"--{name}, " in said for name in names)
    assert "(default: 0.4)" in said
    assert said.index("--camera") < said.index("--max-frames") < said.index("tracker") < said.index("--noise-px")


@pytest.mark.skipif(not DATA.is_dir(), reason=f"the real sequences are not at {DATA}")
def test_a_real_sequence_is_tracked_whole(tmp_path):
    source = DATA / "rig_temple"
    camera = str(source / "camera.json")
    main(["track", str(source), "--camera", camera, "--out", str(tmp_path), "--quiet", "--no-overlay"])
    errors = evaluate(read_tum(tmp_path / "trajectory.txt"), read_tum(source / "groundtruth.txt"))
    assert errors.matched == 19
    assert errors.ate_percent < 1
