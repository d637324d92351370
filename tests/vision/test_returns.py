import numpy as np
from test_klt import SETTINGS, moved, texture

from jaxtri.vision.klt import KLT


def test_features_are_found_again_where_they_were_given_up():
    image, klt = texture(), KLT(SETTINGS)
    first = klt.track(image)
    assert first.returns is None
    klt.lost = True
    for seed in (1, 2, 3):  # something else, which holds none of them
        assert klt.track(texture(seed)).returns is None
    again = klt.track(moved(image, (9.3, -6.2)))
    found = again.returns
    assert found is not None
    assert len(found.now) > 0.4 * first.visible.sum()
    assert found.frame == 0
    before, now = (dict(zip(x.ids[x.visible], x.pixels[x.visible], strict=True)) for x in (first, again))
    assert not set(now) & set(before)
    way = np.array([now[i] - before[j] for i, j in zip(found.now, found.before, strict=True)])
    assert np.percentile(np.linalg.norm(way - [9.3, -6.2], axis=1), 95) < 0.2
    # Fresh features are put where those before them are found.
    fresh = np.isin(found.now, again.ids[again.fresh])
    assert fresh.mean() > 0.9
    np.testing.assert_allclose([now[i] for i in found.now[fresh]], found.pixels[fresh], atol=1e-4)


def test_places_are_looked_for_only_where_most_features_are_new():
    image, klt = texture(size=(360, 480)), KLT(SETTINGS)
    for k in range(10):
        assert klt.track(moved(image, (0.5 * k, 0.0))).returns is None
    assert [place.frame for place in klt._places.kept] == [0]
