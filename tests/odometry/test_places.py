from typing import NamedTuple

import numpy as np
import pytest
from tracks import CAPACITY, make

from jaxtri.errors import InputError
from jaxtri.odometry.driver import Odometry
from jaxtri.odometry.refine import refine
from jaxtri.odometry.settings import Status
from jaxtri.trajectory import Trajectory, evaluate
from jaxtri.vision.places import Returns

LEFT, BACK, FRAMES = 25, 35, 50
NEW = 1000  # numbers that tracks have once they are seen again, over those that they had


def path(frames=FRAMES):
    t = np.arange(frames)[:, None]
    return make(t * [0.03, 0.002, 0.004], t * [0.0, 0.002, 0.001])


def returns(tracks, frame, before, *, wrong=0.2, seed=0):
    """What is seen both in a frame and in an earlier one, with a share of pairs that are none."""
    rng = np.random.default_rng(seed)
    both = np.flatnonzero(tracks.visible[frame] & tracks.visible[before])
    other = both.copy()
    mixed = rng.choice(len(both), round(wrong * len(both)), replace=False)
    other[mixed] = np.roll(other[mixed], 1)
    return Returns(both + NEW, other, tracks.pixels[frame, both], before)


def feed(odometry, tracks, frames, told=()):
    told = dict(told)
    for k in frames:
        gone = LEFT <= k < BACK
        seen = tracks.visible[k] & (not gone)
        odometry.add(
            tracks.pixels[k], seen, float(k), ids=np.arange(CAPACITY) + (NEW if k >= BACK else 0), returns=told.get(k)
        )
    odometry.finish()
    return odometry


def sure(tracks, poses):
    """Errors of the frames that have a measured pose."""
    kept = np.array([k for k, p in enumerate(poses) if p.status.measured])
    T = np.linalg.inv(np.stack([poses[k].T_camera_world for k in kept]))
    return evaluate(Trajectory(kept.astype(float), T), Trajectory(kept.astype(float), tracks.T_world_camera[kept]))


@pytest.fixture(scope="module")
def found():
    tracks = path()
    odometry = Odometry(tracks.camera, record=True, capacity=CAPACITY)
    return tracks, feed(odometry, tracks, range(FRAMES), {BACK: returns(tracks, BACK, LEFT - 1)})


def test_what_was_lost_is_found_again_in_its_world_and_at_its_scale(found):
    tracks, odometry = found
    status = [p.status for p in odometry.poses]
    assert Status.LOST in status[LEFT:BACK]
    assert status[BACK] is Status.FOUND
    assert set(status[BACK + 1 :]) == {Status.TRACKING}
    assert odometry.scale_unknown_from is None
    (again,) = odometry.found
    assert (again.frame, again.place) == (BACK, LEFT - 1)
    assert LEFT <= again.since < BACK
    assert again.points > 40
    # 0.3 px at 500 px and 4 m deep is 2.4 mm; the path is 1.5 m.
    assert sure(tracks, odometry.poses).ate_percent < 0.4
    refined = refine(odometry)
    (part,) = refined.statistics["parts"]
    assert [first for first, _ in part["spans"]] == [0, BACK]
    assert [(loop["frame"], loop["place"]) for loop in part["loops"]] == [(BACK, LEFT - 1)]
    assert sure(tracks, refined.poses).ate_percent < 0.4
    apart = refine(odometry, loops=False).statistics["parts"]
    assert [p["frames"][0] for p in apart] == [0, BACK]


def test_it_goes_on_after_it_was_written_and_read(found, tmp_path):
    tracks, whole = found
    odometry = feed(Odometry(tracks.camera, record=True, capacity=CAPACITY), tracks, range(BACK - 2))
    odometry.save(tmp_path / "lost.npz")
    odometry = Odometry.load(tmp_path / "lost.npz")
    feed(odometry, tracks, range(BACK - 2, FRAMES), {BACK: returns(tracks, BACK, LEFT - 1)})
    for one, other in zip(whole.poses[BACK:], odometry.poses[BACK:], strict=True):
        np.testing.assert_array_equal(one.T_camera_world, other.T_camera_world)


def test_pairs_that_agree_on_no_pose_find_nothing(found):
    tracks, _ = found
    odometry = Odometry(tracks.camera, capacity=CAPACITY)
    feed(odometry, tracks, range(FRAMES), {BACK: returns(tracks, BACK, LEFT - 1, wrong=1.0)})
    assert not odometry.found
    assert Status.FOUND not in [p.status for p in odometry.poses]
    assert odometry.scale_unknown_from is not None


def test_what_was_followed_between_is_called_uncertain():
    """A new start comes first: what it followed was at a scale of its own, and may have been something else."""
    tracks, late = path(FRAMES + 20), FRAMES + 17
    odometry = Odometry(tracks.camera, capacity=CAPACITY)
    feed(odometry, tracks, range(FRAMES + 20), {late: returns(tracks, late, LEFT - 1)})
    assert odometry.starts == 2
    assert odometry.poses[late].status is Status.FOUND
    assert odometry.scale_unknown_from is None
    between = [p for p in odometry.poses[BACK:late] if p.status.measured]
    assert len(between) > 20
    assert {p.status for p in between} == {Status.UNCERTAIN}
    assert all(p.start == 1 and f"found again in frame {late}" in "; ".join(p.doubts) for p in between)
    assert all(p.start == 0 for p in odometry.poses[late:])


def test_a_start_that_is_worked_out_is_not_waited_for(found):
    """Once a place is seen again the newest pose is there, and the frames that queued stay without one."""
    tracks, _ = found
    odometry, late = Odometry(tracks.camera, capacity=CAPACITY), FRAMES - 3
    feed(odometry, tracks, range(BACK))
    told = returns(tracks, late, LEFT - 1)
    for k in range(BACK, late + 1):
        ids, back = np.arange(CAPACITY) + NEW, told if k == late else None
        odometry.add(tracks.pixels[k], tracks.visible[k], float(k), ids=ids, returns=back)
        if k == late - 1:
            assert odometry.latest.time < late - 1  # the start has begun: frames queue
    assert odometry.latest.time == late
    assert odometry.latest.status is Status.FOUND
    assert not odometry.lost
    assert odometry.starts == 1
    assert {p.status for p in odometry.poses[BACK:late]} == {Status.LOST}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frame": 3}, "returns.frame is 3 in frame 0"),
        ({"before": np.zeros(1, int)}, "returns.before"),
        ({"pixels": np.zeros((2, 3))}, "returns.pixels"),
    ],
)
def test_returns_that_do_not_fit_are_refused(change, words):
    tracks = path()
    told = Returns(np.arange(2), np.arange(2), np.zeros((2, 2)), 0)._replace(**change)
    with pytest.raises(InputError, match=words):
        Odometry(tracks.camera).add(tracks.pixels[0], tracks.visible[0], 0.0, returns=told)


AROUND, POINTS = 100, 210  # frames there and back, points of the wall


class Around(NamedTuple):
    """Along a wall and back: a point that comes into view again is a track of its own, whose error walks anew."""

    pixels: np.ndarray  # (t, n, 2)
    visible: np.ndarray  # (t, n)
    ids: np.ndarray  # (t, n)
    T_world_camera: np.ndarray

    @classmethod
    def make(cls, seed=0):
        rng, t = np.random.default_rng(seed), np.arange(AROUND)
        way = np.minimum(t, AROUND - 1 - t)
        T = np.tile(np.eye(4), (AROUND, 1, 1))
        T[:, :3, 3] = way[:, None] * [0.12, 0.004, 0.006]
        points = rng.uniform([-2.5, -1.6, 3.5], [9.0, 1.6, 6.0], (POINTS, 3))
        cam = np.einsum("tji,tnj->tni", T[:, :3, :3], points - T[:, None, :3, 3])
        pixels = 500 * cam[..., :2] / cam[..., 2:] + [320, 240]
        visible = (pixels > 0).all(-1) & (pixels < [640, 480]).all(-1)
        visit = np.cumsum(np.diff(visible, axis=0, prepend=False) & visible, axis=0)
        walks, each = np.zeros_like(pixels), np.arange(POINTS)
        for k in range(1, visit.max() + 1):
            walk = np.cumsum(rng.normal(scale=0.15, size=pixels.shape), axis=0)
            walks = np.where((visit == k)[..., None], walk - walk[np.argmax(visit == k, axis=0), each], walks)
        noise = rng.normal(scale=0.1, size=pixels.shape)
        return cls(pixels + walks + noise, visible, np.arange(POINTS) + NEW * visit, T)

    def returns(self, shift=(0.0, 0.0)):
        """On the last frames, what is of the first ones; in one of them by so many pixels elsewhere."""
        found = {}
        for k in range(AROUND - 20, AROUND, 4):
            before = AROUND - 1 - k
            both = np.flatnonzero(self.visible[k] & self.visible[before] & (self.ids[k] != self.ids[before]))
            pixels = self.pixels[k, both] + (shift if k == AROUND - 8 else (0, 0))
            found[k] = Returns(self.ids[k, both], self.ids[before, both], pixels, before)
        return found

    def followed(self, returns):
        odometry = Odometry(path(2).camera, record=True, capacity=CAPACITY)
        for k in range(AROUND):
            seen = self.visible[k]
            odometry.add(self.pixels[k, seen], seen[seen], float(k), ids=self.ids[k, seen], returns=returns.get(k))
        return odometry

    def error(self, refined):
        """Of the last position, seen from the first camera, over the length of the path."""
        T = np.linalg.inv(np.stack([p.T_camera_world for p in refined.poses]))
        found = evaluate(refined.trajectory(), Trajectory(refined.trajectory().times, self.T_world_camera))
        way = [np.linalg.inv(x[0]) @ x[-1] for x in (T, self.T_world_camera)]
        return np.linalg.norm(found.scale * way[0][:3, 3] - way[1][:3, 3])


@pytest.fixture(scope="module")
def around():
    return Around.make()


def test_a_path_that_comes_back_is_closed(around):
    odometry = around.followed(around.returns())
    assert odometry.starts == 1
    closed, open_ = refine(odometry), refine(odometry, loops=False)
    assert around.error(closed) < 0.3 * around.error(open_)
    (part,) = closed.statistics["parts"]
    assert [loop["frame"] for loop in part["loops"]] == [80, 84, 88, 92, 96]
    assert all(loop["weight"] > 0.25 for loop in part["loops"])
    assert np.trace(closed.poses[-1].covariance) < np.trace(open_.poses[-1].covariance) / 2


def test_a_place_that_does_not_go_with_the_others_counts_little(around):
    odometry = around.followed(around.returns(shift=(25.0, -10.0)))
    closed, open_ = refine(odometry), refine(odometry, loops=False)
    (part,) = closed.statistics["parts"]
    weights = {loop["frame"]: loop["weight"] for loop in part["loops"]}
    assert weights.pop(92) < 0.05
    assert min(weights.values()) > 0.25
    assert around.error(closed) < 0.3 * around.error(open_)
