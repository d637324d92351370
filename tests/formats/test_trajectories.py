"""Trajectory files as other programs write them: one trajectory in every form, and evo's readers as twins."""

import warnings

import numpy as np
import pytest
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from jaxtri import formats
from jaxtri.errors import TrajectoryError, TrajectoryWarning
from jaxtri.formats.trajectories import read_pair
from jaxtri.trajectory import Trajectory

T0 = 1_403_636_579_763_555_584  # ns


def motion(t=8):
    rng = np.random.default_rng(1)
    T = np.eye(4)[None].repeat(t, 0)
    T[:, :3, :3] = Rotation.random(t, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(size=(t, 3))
    return Trajectory((T0 + 50_000_000 * np.arange(t)) / 1e9, T)


def table(separator, order, unit, head="", more=""):
    """The motion as text; `order` of the quaternion from x y z w, `unit` a function of the nanoseconds."""
    truth = motion()
    q = Rotation.from_matrix(truth.rotations).as_quat()[:, order]
    rows = [head] if head else []
    for k, (p, r) in enumerate(zip(truth.positions, q, strict=True)):
        rows.append(separator.join([unit(T0 + 50_000_000 * k), *(f"{x:.12f}" for x in (*p, *r)), *more.split()]))
    return "\n".join(rows) + "\n"


XYZW, WXYZ = [0, 1, 2, 3], [3, 0, 1, 2]


def seconds(ns):
    return f"{ns // 10**9}.{ns % 10**9:09d}"


TUM_NAMES = "timestamp tx ty tz qx qy qz qw"
EUROC_NAMES = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v_RS_R_x [m s^-1]"
)
FORMS = {
    "tum": table(" ", XYZW, seconds),
    "tum with its names": table(" ", XYZW, seconds, "# " + TUM_NAMES),
    "tum with tabs": table("\t", XYZW, seconds),
    "tum with commas": table(",", XYZW, seconds),
    "tum with commas and blanks": table(", ", XYZW, seconds, TUM_NAMES.replace(" ", ", ")),
    "tum with commas and a head": table(",", XYZW, seconds, TUM_NAMES.replace(" ", ",")),
    "tum with semicolons": table(";", XYZW, seconds, TUM_NAMES.replace(" ", ";")),
    "euroc": table(",", WXYZ, str, EUROC_NAMES, "0.1"),
    "euroc without its head": table(",", WXYZ, str, more="0.1 0.2"),
    "euroc, eight columns": table(",", WXYZ, str),
    "euroc, seconds by its head": table(",", WXYZ, seconds, "#timestamp [s],px,py,pz,qw,qx,qy,qz"),
    "tum's order, nanoseconds by its head": table(",", XYZW, str, "time_ns,x,y,z,qx,qy,qz,qw"),
    "numbered": "\n".join(
        line if line[0] == "#" else f"{k} {line}"
        for k, line in enumerate(table(" ", XYZW, seconds, "# id " + TUM_NAMES).splitlines())
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_one_trajectory_in_every_form(tmp_path, form):
    (tmp_path / "t").write_text(FORMS[form])
    found, truth = formats.read_trajectory(tmp_path / "t"), motion()
    np.testing.assert_allclose(found.times, truth.times, rtol=0, atol=3e-7)
    np.testing.assert_allclose(found.T_world_camera, truth.T_world_camera, atol=1e-10)
    assert found.frames is None


@pytest.mark.parametrize(
    "form", ["tum", "tum with its names", "euroc", "euroc without its head", "euroc, eight columns"]
)
def test_evo_reads_the_same(tmp_path, form):
    (tmp_path / "t").write_text(FORMS[form])
    kind = "read_tum_trajectory_file" if "tum" in form else "read_euroc_csv_trajectory"
    theirs = getattr(file_interface, kind)(str(tmp_path / "t"))
    ours = formats.read_trajectory(tmp_path / "t")
    np.testing.assert_array_equal(ours.times, theirs.timestamps)
    np.testing.assert_allclose(ours.T_world_camera, np.array(theirs.poses_se3), atol=1e-9)


def test_evo_reads_kitti_the_same(tmp_path):
    formats.write_kitti(tmp_path / "k", motion())
    ours, theirs = formats.read_trajectory(tmp_path / "k"), file_interface.read_kitti_poses_file(str(tmp_path / "k"))
    np.testing.assert_array_equal(ours.T_world_camera, np.array(theirs.poses_se3))
    assert ours.frames == theirs.num_poses == 8


def test_other_units_in_tum_are_converted_and_said(tmp_path):
    for unit, divide in (("nanoseconds", 1), ("microseconds", 10**3), ("milliseconds", 10**6)):
        (tmp_path / "t").write_text(table(" ", XYZW, lambda ns, d=divide: f"{ns // d}"))
        with pytest.warns(TrajectoryWarning, match=unit):
            found = formats.read_trajectory(tmp_path / "t")
        np.testing.assert_allclose(found.times, motion().times, rtol=0, atol=2e-3)


def test_repeated_stamps_and_nan_are_left_out_and_counted(tmp_path):
    lines = table(" ", XYZW, seconds).splitlines()
    other = lines[3].split()[0] + " 9 9 9 0 0 0 1"  # another pose at the same time: the first one stays
    (tmp_path / "t").write_text("\n".join([*lines[:4], lines[3], other, *lines[4:]]))
    with pytest.warns(TrajectoryWarning, match="2 of 10 lines repeat.*line 5 first"):
        found = formats.read_trajectory(tmp_path / "t")
    np.testing.assert_allclose(found.T_world_camera, motion().T_world_camera, atol=1e-10)
    nan = [f"{line.split()[0]} nan NaN nan nan nan nan nan" for line in lines]
    (tmp_path / "t").write_text("\n".join([*nan[:2], *lines[2:7], nan[7]]))
    with pytest.warns(TrajectoryWarning, match="3 of 8 lines hold NaN"):
        found = formats.read_trajectory(tmp_path / "t")
    np.testing.assert_allclose(found.T_world_camera, motion().T_world_camera[2:7], atol=1e-10)
    for content, message in (
        ([*lines[:4], lines[2]], "t:5: timestamps must increase"),
        (nan, "all of its 8 lines hold NaN"),
    ):
        (tmp_path / "t").write_text("\n".join(content))
        with pytest.raises(TrajectoryError, match=message):
            formats.read_trajectory(tmp_path / "t")


def test_a_kitti_file_with_nan_keeps_the_numbers_of_its_lines(tmp_path):
    formats.write_kitti(tmp_path / "k", motion())
    lines = (tmp_path / "k").read_text().splitlines()
    (tmp_path / "k").write_text("\n".join([*lines[:3], " ".join(["nan"] * 12), *lines[4:]]))
    times = 0.1 * np.arange(8)
    with pytest.warns(TrajectoryWarning, match="1 of 8"):
        bare, timed = formats.read_kitti(tmp_path / "k"), formats.read_kitti(tmp_path / "k", times)
    assert bare.frames == 8
    np.testing.assert_array_equal(bare.times, [0, 1, 2, 4, 5, 6, 7])
    np.testing.assert_array_equal(timed.times, np.delete(times, 3))
    assert timed.frames is None


@pytest.mark.parametrize("place", ["poses", ".", "sequences/07"])
def test_times_beside_a_kitti_file_are_found_and_said(tmp_path, place):
    truth = motion()
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    stamps = tmp_path / place / "times.txt"
    formats.write_kitti(tmp_path / "poses" / "07.txt", truth)
    formats.write_tum(tmp_path / "e", truth)
    stamps.write_text("".join(f"{t:.9f}\n" for t in truth.times))
    with pytest.warns(TrajectoryWarning, match=r"KITTI.*no times.*times\.txt"):
        _, found = read_pair(tmp_path / "e", tmp_path / "poses" / "07.txt")
    np.testing.assert_allclose(found.times, truth.times, atol=1e-8)
    with warnings.catch_warnings():  # two without times are compared line by line: no word needed
        warnings.simplefilter("error")
        assert [x.frames for x in read_pair(*[tmp_path / "poses" / "07.txt"] * 2)] == [8, 8]
    stamps.write_text("0\n1\n")  # those of another sequence
    assert read_pair(tmp_path / "e", tmp_path / "poses" / "07.txt")[1].frames == 8


def test_times_of_a_kitti_file_can_be_given(tmp_path):
    truth = motion()
    formats.write_kitti(tmp_path / "k", truth)
    formats.write_tum(tmp_path / "e", truth)
    stamps = tmp_path / "stamps"
    stamps.write_text("".join(f"{T0 + 50_000_000 * k}\n" for k in range(8)))
    found, _ = read_pair(tmp_path / "k", tmp_path / "e", stamps)
    np.testing.assert_allclose(found.times, truth.times, atol=3e-7)
    stamps.write_text("0\n1\n")
    with pytest.raises(TrajectoryError, match=r"2 times.*8 lines"):
        read_pair(tmp_path / "k", tmp_path / "e", stamps)
    with pytest.raises(TrajectoryError, match=r"2 times.*neither"):
        read_pair(tmp_path / "e", tmp_path / "e", stamps)
