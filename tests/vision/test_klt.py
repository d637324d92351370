import cv2
import numpy as np
import pytest

from jaxtri.errors import ResolutionChangeError
from jaxtri.vision.klt import KLT, KLTSettings

SETTINGS = KLTSettings(capacity=150)


def texture(seed: int = 0, size: tuple[int, int] = (360, 480)) -> np.ndarray:
    """Smooth random texture with corners at several scales."""
    rng = np.random.default_rng(seed)
    image = np.zeros(size)
    for k in (4, 8, 16):
        small = rng.random((size[0] // k + 1, size[1] // k + 1))
        image += cv2.resize(small, (size[1], size[0]), interpolation=cv2.INTER_CUBIC)
    image = (image - image.min()) / np.ptp(image)
    return (255 * image).astype(np.uint8)


def moved(image: np.ndarray, shift: tuple[float, float]) -> np.ndarray:
    M = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], float)
    return cv2.warpAffine(image, M, image.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def test_sub_pixel_motion_is_followed_without_drift():
    image, klt = texture(), KLT(SETTINGS)
    first = klt.track(image)
    for k in range(1, 31):
        tracks = klt.track(moved(image, (0.7 * k, -0.3 * k)))
    kept = first.visible & tracks.visible & (first.ids == tracks.ids)
    error = tracks.pixels[kept] - first.pixels[kept] - [21.0, -9.0]
    assert kept.sum() > 60
    # Against the frame they were found in, thirty steps later, not thirty roundings on top of each other.
    assert np.median(np.linalg.norm(error, axis=1)) < 0.05


@pytest.mark.parametrize("shift", [(-190.0, 12.0), (60.0, -140.0)])
def test_features_are_followed_where_the_image_jumps(shift):
    image, klt = texture(size=(480, 640)), KLT(SETTINGS)
    rng = np.random.default_rng(1)
    noisy = [
        (x + rng.normal(scale=3, size=x.shape)).clip(0, 255).astype(np.uint8) for x in (image, moved(image, shift))
    ]
    first, second = (klt.track(x) for x in noisy)
    there = first.pixels + shift
    stays = first.visible & (there > 20).all(axis=1) & (there < [620, 460]).all(axis=1)
    kept = stays & second.visible & (first.ids == second.ids)
    assert kept.sum() > 0.8 * stays.sum() > 40
    assert np.percentile(np.linalg.norm(second.pixels - there, axis=1)[kept], 95) < 0.5


def test_no_feature_is_kept_or_found_where_the_image_is_ignored():
    image, klt = texture(), KLT(SETTINGS)
    logo = np.zeros(image.shape, bool)
    logo[100:200, 150:300] = True
    reach = SETTINGS.window // 2

    def inside(tracks):
        x, y = tracks.pixels[tracks.visible].T
        return (x > 150 - reach) & (x < 299 + reach) & (y > 100 - reach) & (y < 199 + reach)

    # Put on a picture, it takes the features that are there; the camera moves, and none comes in.
    assert inside(klt.track(image)).sum() > 10
    for k in range(1, 6):
        tracks = klt.track(moved(image, (6.0 * k, 0.0)), logo)
        assert tracks.visible.sum() > 80
        assert not inside(tracks).any()
    with pytest.raises(ResolutionChangeError, match="ignore is of shape"):
        klt.track(image, logo.T.copy())


def test_slots_ids_and_births():
    image, klt = texture(), KLT(SETTINGS)
    before = klt.track(image)
    assert before.fresh.sum() == before.visible.sum() > 100
    for k in range(1, 25):
        now = klt.track(moved(image, (9.0 * k, 0)))
        same = before.visible & now.visible & ~now.fresh
        np.testing.assert_array_equal(before.ids[same], now.ids[same])
        assert not (now.fresh & ~now.visible).any()
        assert set(now.ids[now.fresh]).isdisjoint(before.ids)
        alive = now.ids[now.visible]
        assert len(np.unique(alive)) == len(alive)
        assert now.visible.sum() > 0.5 * SETTINGS.capacity
        before = now


def test_features_are_spread_over_the_image():
    image = texture()
    image[:, :240] = 128 + (image[:, :240].astype(int) - 128) // 4  # the left half has little contrast
    tracks = KLT(SETTINGS).track(image)
    left = tracks.pixels[tracks.visible][:, 0] < 240
    assert 0.3 < left.mean() < 0.7


def test_outliers_given_up_free_their_slots():
    klt = KLT(SETTINGS)
    first = klt.track(texture())
    klt.drop(first.ids[first.visible])
    second = klt.track(texture())
    assert second.fresh.sum() == second.visible.sum() > 100
    assert set(second.ids[second.visible]).isdisjoint(first.ids)


def test_blank_and_static_images_and_a_change_of_size():
    klt = KLT(SETTINGS)
    blank = np.full((360, 480), 90, np.uint8)
    assert not klt.track(blank).visible.any()
    assert not klt.track(blank).visible.any()
    first = klt.track(texture())
    assert first.visible.any()
    np.testing.assert_allclose(klt.track(texture()).pixels[first.visible], first.pixels[first.visible], atol=0.01)
    assert not klt.track(blank).visible.any()
    with pytest.raises(ResolutionChangeError, match=r"frame 5 is 240x180.*480x360"):
        klt.track(np.zeros((180, 240), np.uint8))
