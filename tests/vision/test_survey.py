"""What a survey sees: a clean clip has no fault, and each fault is found where it is, and no other."""

import json

import cv2
import numpy as np
import pytest
from footage import clip, dissolving

from jaxtri.cli import main
from jaxtri.errors import InputError
from jaxtri.odometry.settings import StartSettings
from jaxtri.output.check import check_text, findings, verdict
from jaxtri.vision.dissolves import MIXED, mixture
from jaxtri.vision.klt import KLT, KLTSettings
from jaxtri.vision.pictures import look
from jaxtri.vision.survey import COMMON, FLOW, POINTS, survey
from jaxtri.vision.video import Frame

N = 20


def images():
    return [frame.image for frame in clip(N).frames]


def surveyed(pictures):
    return survey((Frame(k, k / 25, image) for k, image in enumerate(pictures)), progress=False)


def noisy(image, sigma=1.0, seed=0):
    noise = np.random.default_rng(seed).normal(scale=sigma, size=image.shape)
    return np.clip(image + noise, 0, 255).round().astype(np.uint8)


def smeared(image):
    """Blurred along a diagonal, by 15 pixels; the noise of the sensor is not."""
    return noisy(cv2.filter2D(image, -1, np.eye(15) / 15))


def changed(at, change):
    return [change(image) if k in at else image for k, image in enumerate(images())]


def woven(first, second):
    """Two moments in one frame, as an interlaced film has them."""
    image = first.copy()
    image[1::2] = second[1::2]
    return image


def turning():
    """One picture, turned and enlarged: what a tripod with a zoom shows."""
    large = cv2.resize(images()[0], (640, 480))
    warps = [cv2.getRotationMatrix2D((320, 240), 0.7 * k, 1 + 0.01 * k) for k in range(N)]
    return [noisy(cv2.warpAffine(large, M, (640, 480))[60:-60, 80:-80], seed=k) for k, M in enumerate(warps)]


def test_a_clean_clip_has_no_fault():
    found = surveyed(images())
    assert findings(found) == []
    assert check_text(found, []).splitlines()[-1] == verdict([]) == "can be tracked"
    assert found.size == (320, 240)
    assert found.seconds == pytest.approx(N / 25)
    assert found.startable
    start = StartSettings()
    assert (start.points, start.common, start.flow) == (POINTS, COMMON, FLOW)


FAULTS = {
    "another shot": (lambda: [*images()[:10], *(255 - image[:, ::-1] for image in images()[10:])], [10]),
    "interlaced": (lambda: [woven(a, b) for a, b in zip(images(), images()[1:], strict=False)], range(N - 1)),
    "repetitions": (lambda: [images()[k - k // 4] for k in range(N)], [4, 8, 12, 16]),
    "blurred": (lambda: changed(range(8, 11), smeared), range(8, 11)),
    "bare": (lambda: changed([9], np.zeros_like), [9]),
    "jump": (lambda: changed([9], lambda image: np.clip(image + 120.0, 0, 255).astype(np.uint8)), [9, 10]),
    "stand still": (lambda: [*(noisy(images()[0], seed=k) for k in range(12)), *images()], range(1, 13)),
    "dark": (lambda: [noisy(0.06 * image, 0.5, k) for k, image in enumerate(images())], []),
    "only turns or zooms": (turning, []),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_found_where_it_is(fault):
    make, frames = FAULTS[fault]
    wrong = findings(surveyed(make()))
    assert verdict(wrong) == "can be tracked, but"
    found = [finding for finding in wrong if fault in str(finding)]
    assert len(found) == 1, wrong
    assert found[0].frames == tuple(frames)
    # Features are lost where a blur begins and ends, and that is said, too; no other fault is.
    assert all(finding is found[0] or (fault == "blurred" and "jump" in finding.seen) for finding in wrong), wrong


@pytest.mark.parametrize(
    ("said", "make"),
    [
        ("stands still or moves slowly", lambda: [noisy(images()[0], seed=k) for k in range(8)]),
        ("left before the picture has moved", lambda: [noisy(np.full((240, 320, 3), 150), 2, k) for k in range(8)]),
        ("too little to follow", lambda: [np.full((240, 320, 3), 150, np.uint8)] * 8),
        ("at least two", lambda: images()[:1]),
    ],
)
def test_what_cannot_be_tracked_is_named_with_its_reason(said, make):
    wrong = findings(surveyed(make()))
    assert verdict(wrong) == "cannot be tracked"
    assert said in str(wrong[0])


def test_a_flicker_is_named_beside_what_it_stops():
    found = surveyed(
        [np.clip(image * (1 + 0.15 * (-1) ** k), 0, 255).astype(np.uint8) for k, image in enumerate(images())]
    )
    assert any("brightness changes by 30%" in finding.seen for finding in findings(found))
    assert found.flicker == pytest.approx(0.3, abs=0.05)


def test_survival_flow_and_life_are_those_of_the_tracks():
    """Against the tracks themselves, feature by feature."""
    found, klt = surveyed(images()), KLT()
    frames = [klt.track(image) for image in images()]
    seen = [dict(zip(f.ids[f.visible].tolist(), f.pixels[f.visible], strict=True)) for f in frames]
    for k in range(1, N):
        both = seen[k - 1].keys() & seen[k].keys()
        assert found.survival[k] == len(both) / len(seen[k - 1])
        flow = [np.linalg.norm(seen[k][i] - seen[k - 1][i]) for i in both]
        assert found.flow_px[k] == pytest.approx(np.median(flow))
    lives = sorted(sum(i in s for s in seen) for i in set().union(*seen))
    assert found.life == lives[(len(lives) - 1) // 2]
    assert found.features.tolist() == [len(s) for s in seen]


def test_blur_knows_neither_contrast_nor_size_and_grows_with_the_blur():
    sharp = images()[0]
    blurs = [look(cv2.GaussianBlur(sharp, (0, 0), s)).blur for s in (0.5, 1, 2, 4)]
    assert blurs == sorted(blurs)
    assert look((0.4 * sharp + 60).astype(np.uint8)).blur == pytest.approx(look(sharp).blur, abs=0.03)
    large = cv2.resize(sharp, (1280, 960), interpolation=cv2.INTER_CUBIC)
    assert look(large).blur == pytest.approx(look(cv2.resize(large, (640, 480))).blur, abs=0.05)


def test_no_frames_are_no_survey():
    with pytest.raises(InputError, match="no frames"):
        surveyed([])


def test_the_command_line_says_it_and_writes_it(tmp_path, capsys):
    (tmp_path / "frames").mkdir()
    for k, image in enumerate(changed(range(8, 11), smeared)):
        cv2.imwrite(str(tmp_path / "frames" / f"{k}.png"), image)
    main(["check", str(tmp_path / "frames"), "--json", str(tmp_path / "c.json"), "--quiet"])
    said = capsys.readouterr()
    assert "25 frames a second are assumed" in said.err  # as `track` warns
    assert "320x240 pixels" in said.out
    assert "frames 8-10 are blurred" in said.out
    record = json.loads((tmp_path / "c.json").read_text())
    assert record["verdict"] == "can be tracked, but"
    assert record["findings"][0]["frames"] == [8, 9, 10]
    assert len(record["figures"]["blur"]) == N
    assert record["figures"]["survival"][0] is None
    main(["check", str(tmp_path / "frames"), "--max-frames", "8", "--fps", "10", "--quiet"])
    said = capsys.readouterr()
    assert said.err == ""
    assert said.out.splitlines()[-1] == "can be tracked"
    for arguments in (["none.mp4"], [str(tmp_path / "frames"), "--max-frames", "0"]):
        with pytest.raises(SystemExit) as stop:
            main(["check", *arguments])
        assert stop.value.code == 2
        assert "jaxtri: error:" in capsys.readouterr().err


@pytest.mark.parametrize("length", [6, 10])
def test_a_dissolve_is_seen_where_it_is_and_a_haze_or_a_blur_is_none(length):
    found = surveyed(f.image for f in dissolving(length).frames)
    at = np.flatnonzero(found.dissolves)
    assert len(at) >= length // 3
    assert at.min() > 5
    assert at.max() < 5 + length + 1
    (finding,) = (f for f in findings(found) if "dissolve" in f.seen)
    assert 3 <= int(finding.remedy.split("--max-frames ")[1].split()[0]) <= at.min()
    for change in (lambda image: cv2.addWeighted(image, 0.5, np.full_like(image, 140), 0.5, 0), smeared):
        assert not surveyed(changed(range(7, 7 + length), change)).dissolves.any()


def test_the_tracker_gives_up_its_features_once_where_a_dissolve_is_found():
    for find in (True, False):
        klt = KLT(KLTSettings(capacity=128, find_dissolves=find))
        tracks = [klt.track(frame.image) for frame in dissolving(10).frames]
        found = [k for k, t in enumerate(tracks) if t.dissolved is not None]
        assert len(found) == find
        for k in found:
            assert 5 < tracks[k].dissolved < k  # pyright: ignore[reportOptionalOperand]
            assert tracks[k].ids[tracks[k].visible].min() > tracks[k - 1].ids.max()
    pictures = [frame.image[..., 0] for frame in dissolving(10).frames]  # in grey there are no colours to tell shots by
    klt = KLT()
    assert [klt.track(image).dissolved for image in pictures] == [None] * N


def textured(seed):
    """Noise of its own colour and strength in each part."""
    rng = np.random.default_rng(seed)
    coarse = rng.normal(size=(60, 80, 1)) * cv2.resize(rng.uniform(5, 40, (3, 4)), (80, 60))[..., None]
    tint = cv2.resize(rng.uniform(60, 190, (3, 4, 3)), (80, 60))
    return cv2.resize(np.clip(tint + coarse, 0, 255), (320, 240)).astype(np.uint8)


def test_a_mixture_is_told_by_its_contrast():
    """Of two unrelated textures it is the mixture, by the shares that it was made with; what lies between is none."""
    a, b, c = (textured(seed) for seed in range(3))
    half = look(cv2.addWeighted(a, 0.5, b, 0.5, 0))
    assert mixture(look(a), half, look(b)) < MIXED
    assert mixture(look(b), half, look(a)) < MIXED
    assert mixture(look(a), look(c), look(b)) == 1
    assert mixture(look(a), look(cv2.addWeighted(a, 0.98, b, 0.02, 0)), look(b)) == 1
