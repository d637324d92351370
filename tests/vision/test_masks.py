"""Masks of a source: a picture for all frames, or one a frame; white is ignored."""

import re

import cv2
import numpy as np
import pytest

from jaxtri.cli import main
from jaxtri.errors import VideoError
from jaxtri.vision.video import open_source

pytestmark = pytest.mark.filterwarnings("ignore:.*frames a second are assumed")
SIZE = (48, 64)  # rows, columns


@pytest.fixture
def frames(tmp_path):
    (tmp_path / "frames").mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / "frames" / f"{k}.png"), np.full((*SIZE, 3), 60 + k, np.uint8))
    return tmp_path / "frames"


def picture(path, column, size=SIZE):
    image = np.zeros(size, np.uint8)
    image[:, :column] = 255
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), image)
    return path


def columns(source):
    return [int(frame.ignore.any(axis=0).sum()) for frame in source]


def test_a_picture_is_for_all_frames_and_a_folder_has_one_for_each(frames, tmp_path):
    one = picture(tmp_path / "mask.png", 7)
    with open_source(frames, mask=one) as source:
        ignored = [frame.ignore for frame in source]
    np.testing.assert_array_equal(ignored[0], np.arange(SIZE[1]) < np.full((SIZE[0], 1), 7))
    assert ignored[0] is ignored[2]
    for k in range(3):
        picture(tmp_path / "masks" / f"{k}.png", k + 1)
    with open_source(frames, mask=tmp_path / "masks") as source:
        assert columns(source) == [1, 2, 3]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda home: home / "none.png", "mask .*none.png: no such file or folder"),
        (lambda home: picture(home / "m.png", 3, (64, 48)), "mask .* is 48x64, the frames are 64x48"),
        (lambda home: picture(home / "m.png", 64), "white all over, and white is ignored"),
        (lambda home: picture(home / "masks" / "0.png", 3).parent, "holds 1 pictures for 3 frames"),
    ],
)
def test_a_mask_that_does_not_fit_is_named(frames, tmp_path, make, said, capsys):
    with pytest.raises(VideoError, match=said):
        open_source(frames, mask=make(tmp_path))
    with pytest.raises(SystemExit):
        main(["track", str(frames), "--fov", "60", "--mask", str(tmp_path / "masks"), "--out", str(tmp_path / "out")])
    assert re.search("jaxtri: error: mask ", capsys.readouterr().err)
