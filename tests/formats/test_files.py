import json
import math
import struct

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxtri import formats
from jaxtri.errors import InputError, TrajectoryError
from jaxtri.trajectory import Trajectory


def write(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def a_trajectory(t=20):
    rng = np.random.default_rng(0)
    T = np.eye(4)[None].repeat(t, 0)
    T[:, :3, :3] = Rotation.random(t, rng=rng).as_matrix()
    T[0, :3, :3] = np.diag([-1.0, 1, -1])  # half a turn: w is 0
    T[:, :3, 3] = rng.normal(size=(t, 3)) * 10.0 ** np.arange(-5, 5).repeat(2)[:t, None]
    return Trajectory(1403636579.763555 + 0.05 * np.arange(t), T)


# Trajectories and time stamps


@pytest.mark.parametrize("form", ["tum", "euroc", "kitti"])
def test_trajectory_round_trip(tmp_path, form):
    trajectory, path = a_trajectory(), tmp_path / "new" / "folder" / "t.txt"
    getattr(formats, f"write_{form}")(path, trajectory)
    for back in (getattr(formats, f"read_{form}")(path), formats.read_trajectory(path)):
        np.testing.assert_allclose(back.positions, trajectory.positions, rtol=1e-14)
        np.testing.assert_allclose(back.rotations, trajectory.rotations, atol=1e-14)
        expected = np.arange(20.0) if form == "kitti" else trajectory.times
        np.testing.assert_allclose(back.times, expected, rtol=0, atol=3e-7)  # a double at 1.4e9 s
    if form == "kitti":
        np.testing.assert_array_equal(formats.read_kitti(path, trajectory.times).times, trajectory.times)


def test_quaternions_are_in_the_order_of_each_format(tmp_path):
    q = Rotation.from_rotvec([0.3, -0.2, 0.9])
    T = np.eye(4)[None].copy()
    T[0, :3, :3] = q.as_matrix()
    formats.write_tum(tmp_path / "t", Trajectory(np.zeros(1), T), header="two\nlines")
    lines = (tmp_path / "t").read_text().splitlines()
    assert lines[:2] == ["# two", "# lines"]
    np.testing.assert_allclose([float(x) for x in lines[2].split()[4:]], q.as_quat())
    formats.write_euroc(tmp_path / "e", Trajectory(np.ones(1), T))
    *_, line = (tmp_path / "e").read_text().splitlines()
    assert line.startswith("1000000000,0,0,0,")
    np.testing.assert_allclose([float(x) for x in line.split(",")[4:]], q.as_quat()[[3, 0, 1, 2]])


def test_comments_blank_lines_and_further_columns_are_skipped(tmp_path):
    tum = "\ufeff# head\n\n0 1 2 3 0 0 0 1  # the first\r\n\n1 1 2 3 0 0 0 1\n"
    assert len(formats.read_trajectory(write(tmp_path / "t", tum))) == 2
    euroc = "#timestamp, p_RS_R_x [m], ...\n1000000000,1,2,3,1,0,0,0,0.1,0.2\n"
    trajectory = formats.read_trajectory(write(tmp_path / "t", euroc))
    np.testing.assert_array_equal(trajectory.positions, [[1, 2, 3]])
    np.testing.assert_array_equal(trajectory.times, [1.0])
    stamps = "# seconds file\n0.0 frames/0.jpg\n0.1 a name with blanks.jpg\n\n0.2\n"
    np.testing.assert_array_equal(formats.read_timestamps(write(tmp_path / "t", stamps)), [0, 0.1, 0.2])


ROW = "1 2 3 0 0 0 1"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (f"# x\n0 {ROW}\n1 1 2 3\n", "bad:3: expected 8 numbers"),
        (f"0 {ROW}\n1 {ROW} 5\n", "bad:2: expected 8"),
        (f"0 {ROW}\n1 one 2 3 0 0 0 1\n", "bad:2: .*got '1 one"),
        (f"0 {ROW}\n\n-1 {ROW}\n", "bad:3: timestamps must increase"),
        (f"0 {ROW}\n1 1 2 3 0 0 0 2\n", "bad:2: the quaternion"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 -1 0\n", "bad:2: .*no rotation"),
        ("1,2,3\n", "bad: no known trajectory format"),
        ("1 2 3\n", "bad: no known trajectory format.*TUM.*KITTI.*EuRoC"),
        ("# nothing\n", "bad: no known trajectory format"),
    ],
)
def test_bad_trajectory_names_file_and_line(tmp_path, content, message):
    with pytest.raises(TrajectoryError, match=message):
        formats.read_trajectory(write(tmp_path / "bad", content))


def test_bad_timestamps_and_missing_files(tmp_path):
    for content, message in (
        ("0 a\n1 b\n1 c\n", "bad:3: time stamps must increase"),
        ("0 a\nb 1\n", "bad:2: 'b' is not a time in seconds"),
        ("0\ninf\n", "bad:2"),
        ("\n", "holds no data"),
    ):
        with pytest.raises(InputError, match=message):
            formats.read_timestamps(write(tmp_path / "bad", content))
    with pytest.raises(InputError, match="cannot be read"):
        formats.read_timestamps(tmp_path)
    with pytest.raises(TrajectoryError, match="cannot be read"):
        formats.read_trajectory(tmp_path / "none")


# Writers


def test_ply_holds_what_was_given(tmp_path):
    rng = np.random.default_rng(0)
    points, colours = rng.normal(size=(7, 3)), rng.integers(0, 256, (7, 3), dtype=np.uint8)
    formats.write_ply(tmp_path / "p.ply", points, colours, {"sigma": np.arange(7.0)})
    head, _, body = (tmp_path / "p.ply").read_bytes().partition(b"end_header\n")
    kinds = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
    names = ["x", "y", "z", "red", "green", "blue", "sigma"]
    assert kinds == [["uchar" if n in names[3:6] else "float", n] for n in names]
    assert b"element vertex 7\n" in head
    rows = np.array(list(struct.iter_unpack("<3f3Bf", body)))
    np.testing.assert_array_equal(rows, np.c_[points.astype(np.float32), colours, np.arange(7)])
    formats.write_ply(tmp_path / "p.ply", points[:0])
    assert (tmp_path / "p.ply").read_bytes().endswith(b"end_header\n")
    for extra in ({"x": np.zeros(7)}, {"two words": np.zeros(7)}, {"sigma": np.zeros((7, 1))}):
        with pytest.raises((InputError, TypeError)):
            formats.write_ply(tmp_path / "p.ply", points, colours, extra)


def test_json_is_strict(tmp_path):
    obj = {
        "a": np.float32(1.5),
        "b": jnp.arange(3),
        "c": [math.nan, (np.inf, True)],
        4: a_trajectory(2),
        "n": None,
    }
    formats.write_json(tmp_path / "j.json", obj)
    back = json.loads((tmp_path / "j.json").read_text())
    assert (back["a"], back["b"], back["c"], back["n"]) == (1.5, [0, 1, 2], [None, [None, True]], None)
    assert np.shape(back["4"]["T_world_camera"]) == (2, 4, 4)


def test_nothing_half_written_is_left(tmp_path):
    path = tmp_path / "sub" / "file.txt"
    with formats.atomic_write(path) as file:
        file.write("old\n")
        assert not path.exists()

    def interrupted():
        with formats.atomic_write(path) as file:
            file.write("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with pytest.raises(TypeError):
        formats.write_json(path, {"bad": object()})
    assert path.read_bytes() == b"old\n"
    with pytest.raises(InputError, match="nothing was written"), formats.atomic_path(path):
        pass
    with formats.atomic_path(path.with_suffix(".png")) as temporary:
        assert cv2.imwrite(str(temporary), np.zeros((2, 2, 3), np.uint8))
    assert sorted(p.name for p in path.parent.iterdir()) == ["file.png", "file.txt"]
