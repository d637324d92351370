"""Calibration files: every form gives the camera that it describes, and what cannot be read or be says why."""

import json
from pathlib import Path

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxtri import formats
from jaxtri.errors import CameraError, InputWarning
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.lenses import BrownConrady, DoubleSphere, ExtendedUnified, FieldOfView, Fisheye

GOOD = {"fx": 500.0, "fy": 510.0, "cx": 320.0, "cy": 240.0, "width": 640, "height": 480}
ROS = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo/left
camera_matrix:
  rows: 3
  cols: 3
  data: [500.0, 0, 320, 0, 510, 240, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {n}
  data: {values}
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""


def write(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def values(camera):
    return [
        float(camera.fx),
        float(camera.fy),
        float(camera.cx),
        float(camera.cy),
        camera.width,
        camera.height,
    ]


def test_camera_json(tmp_path):
    k = [-0.3, 0.08, 1e-3, 2e-3, 0.0]
    entries = GOOD | {"model": "pinhole", "distortion_model": "opencv_radtan (k1,k2,..)", "distortion": k}
    camera = formats.read_camera(write(tmp_path / "c.json", entries | {"skew": -7.5}))
    assert values(camera) == list(GOOD.values())
    assert float(camera.skew) == -7.5
    assert isinstance(camera.distortion, BrownConrady)
    np.testing.assert_array_equal(camera.distortion.coefficients, [*k, 0, 0, 0])
    assert formats.read_camera(write(tmp_path / "c.json", entries | {"distortion": [0] * 5})).distortion is None
    for name in ("fisheye", "opencv_fisheye", "kannala_brandt"):
        for key in ("model", "distortion_model"):
            fisheye = formats.read_camera(write(tmp_path / "c.json", GOOD | {key: name, "distortion": [0.1, 0.2]}))
            assert isinstance(fisheye.distortion, Fisheye)
            np.testing.assert_array_equal(fisheye.distortion.coefficients, [0.1, 0.2, 0, 0])
    bare = {key: value for key, value in GOOD.items() if key not in ("width", "height")}
    path = write(tmp_path / "c.json", bare | {"cy": -1070.5})
    assert (formats.read_camera(path).width, formats.read_camera(path, width=640).width) == (None, 640)


@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
@pytest.mark.parametrize("key", ["distortion_coefficients", "dist_coeffs"])
def test_camera_of_opencv(tmp_path, suffix, key):
    path = tmp_path / f"c.{suffix}"
    k = np.array([[-0.3, 0.08, 1e-3, 2e-3, 0.1]])
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "today: 12:00")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]]))
    storage.write(key, k)
    storage.release()
    camera = formats.read_camera(path)
    assert values(camera) == list(GOOD.values())
    assert camera.distortion is not None
    np.testing.assert_array_equal(camera.distortion.coefficients, [*k[0], 0, 0, 0])


@pytest.mark.parametrize("head", ["", "---\n", "%YAML:1.0\n---\n", "# by a person\n"])
def test_camera_of_ros(tmp_path, head):
    for model, k, kind in (
        ("plumb_bob", [-0.3, 0.1, 0, 0, 0], BrownConrady),
        ("equidistant", [0.0] * 4, Fisheye),
    ):
        text = head + ROS.format(model=model, n=len(k), values=k)
        camera = formats.read_camera(write(tmp_path / "c.yaml", text))
        assert values(camera) == list(GOOD.values())
        assert isinstance(camera.distortion, kind)
        np.testing.assert_array_equal(camera.distortion.coefficients[: len(k)], k)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": None}, "fx is missing; add it"),
        ({"fx": 0}, "fx is 0"),
        ({"fy": -3.5}, "fy is -3.5"),
        ({"cx": float("nan")}, "cx is nan"),
        ({"cy": float("inf")}, "cy is inf"),
        ({"cx": "left"}, "cx is 'left'"),
        ({"width": 0}, "width is 0"),
        ({"height": float("inf")}, "height is inf"),
        ({"height": 480.5}, "height is 480.5"),
        ({"skew": float("nan")}, "skew is nan"),
        ({"model": "mei"}, "'mei' is unknown; known are pinhole.*fisheye"),
        ({"distortion_model": "fov"}, "coefficients of a FieldOfView are missing"),
        ({"distortion": [float("nan")]}, "distortion is .*finite"),
        ({"distortion": "none"}, "distortion is 'none'"),
        ({"distortion": [0.1] * 14}, "tilt"),
        ({"model": "fisheye", "distortion": [0.1] * 5}, "model has 4"),
        ({"camera_matrix": [1.0, 2.0]}, "camera_matrix is .*expected 9"),
    ],
)
def test_bad_camera_names_file_and_key(tmp_path, change, message):
    entries = {key: value for key, value in (GOOD | change).items() if value is not None}
    with pytest.raises(CameraError, match=rf"bad\.json: .*{message}"):
        formats.read_camera(write(tmp_path / "bad.json", entries))


def test_unreadable_cameras(tmp_path):
    with pytest.raises(CameraError, match=r"640x480, but the images are 1280x480"):
        formats.read_camera(write(tmp_path / "c.json", GOOD), width=1280)
    with pytest.raises(CameraError, match=r"none\.json: cannot be read"):
        formats.read_camera(tmp_path / "none.json")
    for content in ("{", "[1, 2]", "", "fx 500\nfy", "<?xml version='1.0'?><a>", "\x00\x01\x02"):
        with pytest.raises(CameraError, match=r"c\.txt: "):
            formats.read_camera(write(tmp_path / "c.txt", content))


def named(names, numbers):
    return dict(zip(names, numbers, strict=False))


# Forms: text, the lens and its coefficients. Each is GOOD but for what the form cannot say.
BROWN, FISH = [-0.3, 0.08, 1e-3, 2e-3], [0.02, -0.01, 4e-3, -6e-4]
CAM = "  camera_model: pinhole\n  intrinsics: [500, 510, 320, 240]\n  resolution: [640, 480]\n"
MESSAGE = """header: {{stamp: {{sec: 3, nanosec: 4}}, frame_id: left}}
height: 480
width: 640
distortion_model: rational_polynomial
{D}: [-0.3, 0.08, 0.001, 2e-3, 0.1, 0.2, -3e-1, 1e-5]
{K}: [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0]
{R}: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
{P}: [480.0, 0.0, 310.0, 0.0, 0.0, 480.0, 230.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
roi: {{x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}}
---
header: {{sta"""
RATIONAL = [*BROWN, 0.1, 0.2, -0.3, 1e-5]
ORB = "%YAML:1.0\n\n#---- left\nCamera.fps: 30\nORBextractor.nLevels: 8\nViewer.ViewpointF: 500\nDepthMapFactor: 1.0\n"
FLAT = {"fx": 500.0, "fy": 510.0, "cx": 320.0, "cy": 240.0}
BASALT = {"T_imu_cam": [{"px": 0, "qw": 1}], "resolution": [[640, 480]], "imu_update_rate": 200.0}
NERF = {"fl_x": 500, "fl_y": 510, "cx": 320.5, "cy": 240.5, "w": 640, "h": 480, "aabb_scale": 4}
PROJECTION = "5e2 0 320 {} 0 510 240 0 0 0 1 0"
PLAIN = {"width": 640, "height": 480}
FORMS = {
    "OpenCV, fisheye flag": (
        "%YAML:1.0\n---\nnr_of_frames:3\nimage_width: 640\nimage_height: 480\nflags: 2\nfisheye_model: 1\n"
        "camera_matrix: !!opencv-matrix\n   rows:3\n   cols: 3\n   dt: d\n"
        "   data: [ 500., 0., 320., 0., 510., 240., 0., 0., 1. ]\n"
        f"distortion_coefficients: !!opencv-matrix\n   rows: 4\n   cols: 1\n   dt: d\n   data: {FISH}\n"
        "per_view_reprojection_errors: [0.1, 0.2]\nextrinsic_parameters: [1, 2]\n",
        Fisheye,
        FISH,
    ),
    "OpenCV, interactive": (
        '<?xml version="1.0"?><opencv_storage><cameraResolution>640 480</cameraResolution>'
        '<cameraMatrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt><data>500. 0. 320.\n 0. 510. 240. '
        "0. 0. 1.</data></cameraMatrix><cameraMatrix_std_dev><rows>4</rows><data>1 1 1 1</data></cameraMatrix_std_dev>"
        f"<dist_coeffs><data>{' '.join(map(str, BROWN))} 0.1</data></dist_coeffs>"
        "<dist_coeffs_std_dev><data>1 1</data></dist_coeffs_std_dev></opencv_storage>",
        BrownConrady,
        [*BROWN, 0.1],
    ),
    "a script's JSON": (
        {"mtx": [[500, 0, 320], [0, 510, 240], [0, 0, 1]], "dist": [[*BROWN, 0.1]], "img_size": [640, 480]},
        BrownConrady,
        [*BROWN, 0.1],
    ),
    "prism": (GOOD | {"dist_coeffs": [*RATIONAL, 1e-3, 2e-3, 3e-3, 4e-3]}, None, [*RATIONAL, 1e-3, 2e-3, 3e-3, 4e-3]),
    "OpenCV, rational of 14": (GOOD | {"D": [*RATIONAL, *[0.0] * 6]}, BrownConrady, RATIONAL),
    "one by one": (GOOD | {"k1": -0.3, "k2": 0.08, "p1": 1e-3, "p2": 2e-3}, BrownConrady, BROWN),
    "ROS, block lists": (
        "image_width: 640\nimage_height: 480\ncamera_name: 0815\ncamera_matrix:\n  cols: 3\n  data:\n"
        + "".join(f"  - {x}\n" for x in (500, 0.0, 320, 0.0, 510, 240, 0.0, 0.0, 1))
        + "  rows: 3\ndistortion_model: fisheye\ndistortion_coefficients:\n  data:\n"
        + "".join(f"  - {x}\n" for x in FISH),
        Fisheye,
        FISH,
    ),
    "ROS 1, printed": (MESSAGE.format(D="D", K="K", R="R", P="P"), BrownConrady, RATIONAL),
    "ROS 2, printed": (MESSAGE.format(D="d", K="k", R="r", P="p"), BrownConrady, RATIONAL),
    "Kalibr": (
        f"cam0:\n{CAM}  distortion_model: equidistant\n  distortion_coeffs: {FISH}\n  rostopic: /a\n",
        Fisheye,
        FISH,
    ),
    "Kalibr, fov": (f"cam0:\n{CAM}  distortion_model: fov\n  distortion_coeffs: [0.9]\n", FieldOfView, [0.9]),
    "Kalibr, ds": (
        "cam0:\n  camera_model: ds\n  intrinsics: [-0.2, 0.6, 500, 510, 320, 240]\n  distortion_model: none\n"
        "  distortion_coeffs: []\n  resolution: [640, 480]\n",
        DoubleSphere,
        [-0.2, 0.6],
    ),
    "Kalibr, omni": (
        "cam0:\n  camera_model: omni\n  intrinsics: [0.6, 800, 816, 320, 240]\n  distortion_model: none\n"
        "  distortion_coeffs: []\n  resolution: [640, 480]\n",
        ExtendedUnified,
        [0.375, 1],
    ),
    "EuRoC": (
        "sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1.0, 0.0]\nrate_hz: 20\nresolution: [640, 480]\n"
        "camera_model: pinhole\nintrinsics: [500, 510, 320, 240] #fu, fv, cu, cv\ndistortion_model: radial-tangential\n"
        f"distortion_coefficients: {BROWN}\n",
        BrownConrady,
        BROWN,
    ),
    "ORB-SLAM2": (
        ORB + "".join(f"Camera.{k}: {v}\n" for k, v in (PLAIN | FLAT | named(("k1", "k2", "p1", "p2"), BROWN)).items()),
        BrownConrady,
        BROWN,
    ),
    "ORB-SLAM3": (
        ORB
        + 'Camera.type: "KannalaBrandt8"\nCamera.width: 640\nCamera.height: 480\n'
        + "".join(f"Camera1.{k}: {v}\n" for k, v in (FLAT | named(("k1", "k2", "k3", "k4"), FISH)).items()),
        Fisheye,
        FISH,
    ),
    "COLMAP, fov": ("# Number of cameras: 1\n7 FOV 640 480 500 510 320.5 240.5 0.9\n", FieldOfView, [0.9]),
    "COLMAP, full": (
        f"1 FULL_OPENCV 640 480 500 510 320.5 240.5 {' '.join(map(str, RATIONAL))}",
        BrownConrady,
        RATIONAL,
    ),
    "KITTI, odometry": ("".join(f"P{k}: {PROJECTION.format(-k)}\n" for k in range(4)) + "Tr: 1 0 0", None, []),
    "KITTI, raw": (
        "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.95e-02\n"
        + "".join(
            f"S_0{k}: 6.40e+02 480\nK_0{k}: 500 0 {320 + k} 0 510 240 0 0 1\nD_0{k}: {' '.join(map(str, BROWN))} 0.1\n"
            f"R_0{k}: 1 0 0\nS_rect_0{k}: 600 400\nP_rect_0{k}: {PROJECTION.format(-k)}\n"
            for k in range(1)
        ),
        BrownConrady,
        [*BROWN, 0.1],
    ),
    "TUM-mono": ("0.78125 1.0625 0.50078125 0.5010416666666667 0.9\n640 480\ncrop\n640 480\n", FieldOfView, [0.9]),
    "DSO": (f"EquiDistant 500 510 320 240 {' '.join(map(str, FISH))}\n640 480\nfull\n600 400\n", Fisheye, FISH),
    "DSO, pinhole": ("Pinhole 500 510 320 240 0\n640 480\nnone\n640 480\n", None, []),
    "one line": ("500, 510, 320, 240, -0.3, 0.08, 1e-3, 2e-3, .1\n", BrownConrady, [*BROWN, 0.1]),
    "a matrix": ("500 0 320\n0 510 240\n0 0 1\n", None, []),
    "nerfstudio": (
        NERF
        | {"camera_model": "OPENCV", "k1": -0.3, "k2": 0.08, "p1": 1e-3, "p2": 2e-3, "frames": [{"file_path": "a"}]},
        BrownConrady,
        BROWN,
    ),
    "nerfstudio, fisheye": (NERF | {"camera_model": "OPENCV_FISHEYE", **named(Fisheye.names, FISH)}, Fisheye, FISH),
    "nerfstudio, a camera a frame": ({"frames": [NERF | {"file_path": name} for name in "ab"]}, None, []),
    "instant-ngp": (
        NERF | {"camera_angle_x": 1.14, "is_fisheye": True, "p1": 0, "p2": 0, **named(Fisheye.names, FISH)},
        Fisheye,
        FISH,
    ),
    "Basalt": (
        {"value0": BASALT | {"intrinsics": [{"camera_type": "kb4", "intrinsics": FLAT | named(Fisheye.names, FISH)}]}},
        Fisheye,
        FISH,
    ),
    "Basalt, ds": (
        {"value0": BASALT | {"intrinsics": [{"camera_type": "ds", "intrinsics": FLAT | {"xi": -0.2, "alpha": 0.6}}]}},
        DoubleSphere,
        [-0.2, 0.6],
    ),
    "Basalt, radtan8": (
        {
            "value0": BASALT
            | {
                "intrinsics": [
                    {
                        "camera_type": "pinhole-radtan8",
                        "intrinsics": FLAT | named(BrownConrady.names, RATIONAL) | {"rpmax": 2.7},
                    }
                ]
            }
        },
        BrownConrady,
        RATIONAL,
    ),
    "RealSense": (
        PLAIN | {"ppx": 320, "ppy": 240, "fx": 500, "fy": 510, "model": "Brown Conrady", "coeffs": [*BROWN, 0.1]},
        BrownConrady,
        [*BROWN, 0.1],
    ),
    "RealSense, inverse of nothing": (
        GOOD | {"model": "distortion.inverse_brown_conrady", "coeffs": [0.0] * 5},
        None,
        [],
    ),
    "RealSense, fisheye": (GOOD | {"model": "distortion.ftheta", "coeffs": [0.9, 0, 0, 0, 0]}, FieldOfView, [0.9]),
    "Open3D": (
        {
            "class_name": "x",
            "intrinsic": PLAIN | {"intrinsic_matrix": [500, 0, 0, 0, 510, 0, 320, 240, 1]},
            "extrinsic": [],
        },
        None,
        [],
    ),
    "VINS": (
        "%YAML:1.0\nmodel_type: PINHOLE\ncamera_name: a\nimage_width: 640\nimage_height: 480\ndistortion_parameters:\n"
        "   k1: -0.3\n   k2: 0.08\n   p1: 1.0e-03\n   p2: 2.0e-03\nprojection_parameters:\n   fx: 500\n   fy: 510\n"
        "   cx: 320\n   cy: 240\nmin_dist: 30\nfisheye: 0\n",
        BrownConrady,
        BROWN,
    ),
    "CamOdoCal, fisheye": (
        "%YAML:1.0\n---\nmodel_type: KANNALA_BRANDT\nimage_width: 640\nimage_height: 480\nprojection_parameters:\n"
        "   k2: 0.02\n   k3: -0.01\n   k4: 4e-3\n   k5: -6e-4\n   mu: 500\n   mv: 510\n   u0: 320\n   v0: 240\n",
        Fisheye,
        FISH,
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_its_camera(tmp_path, form):
    text, lens, coefficients = FORMS[form]
    camera = formats.read_camera(write(tmp_path / "c.x", text), width=640, height=480)
    np.testing.assert_allclose(values(camera), list(GOOD.values()), rtol=1e-12)
    if not coefficients:
        assert camera.distortion is None
        return
    assert isinstance(camera.distortion, lens or BrownConrady)
    np.testing.assert_allclose(camera.distortion.coefficients[: len(coefficients)], coefficients, rtol=1e-15)
    assert not np.any(camera.distortion.coefficients[len(coefficients) :])


def test_an_angle_of_view_needs_a_size(tmp_path):
    path = write(tmp_path / "transforms.json", {"camera_angle_x": np.pi / 2, "frames": []})
    np.testing.assert_allclose(values(formats.read_camera(path, width=640, height=480))[:4], [320, 320, 319.5, 239.5])
    with pytest.raises(CameraError, match="camera_angle_x needs the size"):
        formats.read_camera(path)


def test_of_several_cameras_one_is_chosen(tmp_path):
    other = CAM.replace("500", "505")
    path = write(tmp_path / "chain.yaml", f"cam0:\n{CAM}cam1:\n{other}  T_cn_cnm1: [[1, 0], [0, 1]]\n")
    with pytest.raises(CameraError, match=r"2 cameras that differ, cam0, cam1: choose one, as FILE#cam0"):
        formats.read_camera(path)
    assert [float(formats.read_camera(f"{path}#cam{k}").fx) for k in (0, 1)] == [500, 505]
    with pytest.raises(CameraError, match="no camera cam2; there are cam0, cam1"):
        formats.read_camera(f"{path}#cam2")
    write(path, f"cam0:\n{CAM}cam1:\n{other.replace('640', '800')}")
    assert float(formats.read_camera(path, width=800, height=480).fx) == 505
    assert float(formats.read_camera(write(path, f"cam0:\n{CAM}cam1:\n{CAM}")).fx) == 500
    stereo = "Camera1.fx: 500\nCamera1.fy: 510\nCamera1.cx: 320\nCamera1.cy: 240\n"
    write(path, "Camera.type: PinHole\n" + stereo + stereo.replace("1.", "2.").replace("500", "505"))
    assert float(formats.read_camera(f"{path}#Camera2").fx) == 505
    write(path, FORMS["KITTI, raw"][0])
    assert formats.read_camera(f"{path}#P_rect_00").distortion is None
    assert float(formats.read_camera(path, width=600, height=400).fy) == 510


@pytest.mark.parametrize(
    ("text", "message"),
    [
        # Not half read.
        (GOOD | {"distorsion_coefs": [0.1] * 5}, "distorsion_coefs is not understood"),
        (GOOD | {"camera": {"k1": 0.1}}, r"camera\.k1 is not understood"),
        (GOOD | {"xi": 0.1}, "xi is not understood"),
        (GOOD | {"radial_distortion": [0.1]}, "radial_distortion is not understood"),
        (GOOD | {"model": "fisheye", "distortoin": [0.1] * 4}, "coefficients .* missing.*distortoin"),
        (GOOD | {"imge_width": 640}, "imge_width is not understood.*image_width"),
        (GOOD | {"model": "fisheye", "k1": 0.1, "p1": 0.1}, "tangential"),
        (GOOD | {"k1": 0.1, "k2": 0.1, "k3": 0.1, "k4": 0.1}, "fisheye"),
        (GOOD | {"k2": 0.1}, "k1 is missing"),
        (GOOD | {"distortion": [0.1, 0.2, 0.3]}, "3 coefficients"),
        (GOOD | {"distortion": [0.1] * 4, "D": [0.2] * 4}, "distortion and D disagree"),
        (GOOD | {"distortion_model": "none", "D": [0.1] * 4}, "model is none"),
        (GOOD | {"model": "fov", "distortion": [3.5]}, "omega is 3.5"),
        (GOOD | {"K": [501, 0, 320, 0, 510, 240, 0, 0, 1]}, "K and fx .*disagree"),
        (GOOD | {"model": "inverse_brown_conrady", "coeffs": [0.1] * 5}, "inverse_brown_conrady"),
        (GOOD | {"model": "ds", "distortion_model": "radtan", "D": [0.1] * 4}, "models .* at once"),
        (GOOD | {"resolution": [800, 480]}, "resolution is 800x480"),
        ("cam0:\n" + CAM + "  distortion_coefs2: [1]\n", r"cam0\.distortion_coefs2 is not understood"),
        ("model_type: MEI\nprojection_parameters:\n   gamma1: 3\n", "'MEI' is unknown"),
        ("1 THIN_PRISM_FISHEYE 640 480 1 2 3 4\n", "line 1: COLMAP's model THIN_PRISM_FISHEYE"),
        (MESSAGE.format(D="D", K="K", R="R", P="P").replace("binning_x: 0", "binning_x: 2"), "binning"),
        (NERF | {"k1": 0.1, "k2": 0, "k3": 0, "k4": 0.1, "p1": 0, "p2": 0}, "k4"),
        ({"a": 1}, "holds no camera that is known"),
        ("<calibration><f>3</f></calibration>", "only OpenCV's"),
        ("a: [1\nb: 2\n", "YAML: .* in line 2"),
        # Numbers that cannot be.
        ({"K": [0.0] * 9, "D": []}, "K is all zeros.*not calibrated"),
        (GOOD | {"fx": 0.78, "fy": 1.06, "cx": 0.5, "cy": 0.5}, "fx is 0.78 .*normalised"),
        ({"fx": 4.1, "fy": 4.1, "cx": 320, "cy": 240}, "fx is 4.1 .*millimetres"),
        (GOOD | {"fx": 24, "fy": 24}, "fx is 24 .*millimetres"),
        (GOOD | {"cx": 660}, "cx is 660.*another size"),
        (GOOD | {"cy": -3}, "cy is -3.*from the middle"),
        (GOOD | {"fy": 51}, "fx is 500, but fy 51|fy 51"),
        (GOOD | {"cx": 0, "cy": 0}, "cx and cy are 0"),
        ({"camera_matrix": [[500, 0, 0], [0, 510, 0], [320, 240, 1]]}, "camera_matrix .*transpose"),
    ],
)
def test_what_is_not_understood_or_cannot_be_is_named(tmp_path, text, message):
    with pytest.raises(CameraError, match=rf"c\.x: .*{message}"):
        formats.read_camera(write(tmp_path / "c.x", text), width=640, height=480)


@pytest.mark.parametrize(
    "change",
    [
        {"model": "fisheye", "distortion": [0.0] * 4, "fx": 160, "fy": 160},
        {"fx": 3200, "fy": 3200},
        {"cx": 30, "cy": 470},
        {"fx": 1000},
        {"fps": 30, "rectification_matrix": [1], "projection_matrix": [1], "avg_reprojection_error": 0.2, "rmse_k1": 1},
        {"camera_name": "left", "k1_std": 0.1, "distortion_error": 0.1, "T_cam_imu": [[1]], "roi": {"width": 3}},
    ],
)
def test_rare_cameras_and_entries_of_other_things_pass(tmp_path, change):
    camera = formats.read_camera(write(tmp_path / "c.json", GOOD | change))
    assert float(camera.fx) == (GOOD | change)["fx"]


def test_a_principal_point_far_before_the_image_is_of_a_part_cut_out(tmp_path):
    with pytest.warns(InputWarning, match=r"cy is -1070.*outside the image of 640x480, as of a part"):
        camera = formats.read_camera(write(tmp_path / "c.json", GOOD | {"cy": -1070.5}))
    assert float(camera.cy) == -1070.5


def test_another_size_is_scaled_where_that_is_asked_for(tmp_path):
    path = write(tmp_path / "c.json", GOOD | {"skew": 2.0, "distortion": BROWN})
    with pytest.raises(CameraError, match=r"640x480, but .* 320x240: .*--scale-camera, or read_camera"):
        formats.read_camera(path, width=320, height=240)
    small = formats.read_camera(path, width=320, height=240, scale=True)
    large = formats.read_camera(path, width=640, height=480, scale=True)
    # The corner of the picture and its middle stay where they are.
    xy = jnp.array([[-0.3, 0.2], [0.0, 0.0], [0.4, -0.3]])
    np.testing.assert_allclose(np.asarray(small.to_pixels(xy)) + 0.5, (np.asarray(large.to_pixels(xy)) + 0.5) / 2)
    assert (small.width, small.height) == (320, 240)
    for size, message in (((480, 640), "--turn-camera 90"), ((640, 360), "another aspect")):
        with pytest.raises(CameraError, match=message):
            formats.read_camera(path, width=size[0], height=size[1], scale=True)
    with pytest.raises(CameraError, match="cannot be scaled; add width"):
        formats.read_camera(write(path, FLAT), width=320, height=240, scale=True)


def test_a_quarter_is_turned_where_that_is_asked_for(tmp_path):
    path = write(tmp_path / "c.json", GOOD | {"distortion": BROWN})
    flat = formats.read_camera(path)
    for degrees in (90, 270):
        for size, scale in (((480, 640), False), ((240, 320), True)):
            found = formats.read_camera(path, width=size[0], height=size[1], scale=scale, turn_deg=degrees)
            expected = flat.scaled(*size[::-1]).turned(degrees)
            assert eqx.tree_equal(found, expected)
    for size, more, message in (
        ((480, 640), {}, r"640x480, but .* 480x640: .*--turn-camera 90 where the top .* at the right"),
        ((240, 320), {}, "--turn-camera 90.*; and scale it, by --scale-camera"),
        ((240, 320), {"turn_deg": 90}, "320x240 before they were turned by 90 degrees: .*--scale-camera"),
        ((640, 480), {"turn_deg": 90}, "leave out the turn"),
        ((360, 640), {"turn_deg": 90, "scale": True}, "another aspect"),
        ((640, 480), {"turn_deg": 30}, "cannot be turned by 30"),
    ):
        with pytest.raises(CameraError, match=message):
            formats.read_camera(path, width=size[0], height=size[1], **more)
    # What says no size is of the images as they were before; so is a share of their size.
    assert formats.read_camera(write(path, FLAT), width=480, height=640, turn_deg=90).height == 640


def numbers(n, low=-0.5, high=0.5):
    return st.lists(st.floats(low, high).filter(bool), min_size=n, max_size=n)


LENSES = st.one_of(
    st.tuples(st.sampled_from([BrownConrady]), numbers(8) | numbers(12)),
    st.tuples(st.sampled_from([Fisheye]), numbers(4)),
    st.tuples(st.sampled_from([FieldOfView]), numbers(1, 0, 3)),
    st.tuples(st.sampled_from([DoubleSphere]), st.tuples(st.floats(-0.9, 0.9), st.floats(0, 1))),
    st.tuples(st.sampled_from([ExtendedUnified]), st.tuples(st.floats(0, 1), st.floats(0.01, 3))),
    st.none(),
)


@given(numbers(2, 400, 900), st.floats(0, 639), st.floats(0.1, 479), st.floats(-9, 9), LENSES, st.booleans())
@settings(max_examples=40, deadline=None)
def test_a_camera_that_is_written_is_the_one_that_is_read(tmp_path_factory, f, cx, cy, skew, lens, sized):
    size = {"width": 640, "height": 480} if sized else {}
    distortion = None if lens is None else lens[0].from_coefficients(lens[1])
    camera = Camera.from_parameters(*f, cx, cy, skew=skew, distortion=distortion, **size)
    path = tmp_path_factory.getbasetemp() / "camera.json"
    formats.write_camera(path, camera)
    back = formats.read_camera(path)
    assert jax.tree.structure(back) == jax.tree.structure(camera)
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(camera), strict=True):
        np.testing.assert_array_equal(a, b)


def test_shared_cameras_and_trajectories_if_present():
    folders = [p.parent for p in (Path(__file__).parents[3] / "shared" / "data").glob("*/camera.json")]
    if not folders:
        pytest.skip("no shared data beside the repository")
    for folder in folders:
        camera = formats.read_camera(folder / "camera.json")
        trajectory = formats.read_trajectory(folder / "groundtruth.txt")
        assert camera.width is not None or folder.name == "tracks_oxford_dinosaur"
        if (folder / "timestamps.txt").exists():
            times = formats.read_timestamps(folder / "timestamps.txt")
            assert np.isin(trajectory.times, times).all()


@pytest.mark.parametrize(("told", "columns_rows"), [(0.02, (0.0, 0.02)), ([-0.01, 0.0], (-0.01, 0.0))])
def test_a_readout_is_read_and_written(tmp_path, told, columns_rows):
    entries = {"fx": 500.0, "fy": 500.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480, "readout": told}
    camera = formats.read_camera(write(tmp_path / "camera.json", entries))
    np.testing.assert_allclose(camera.readout, columns_rows)
    formats.write_camera(tmp_path / "again.json", camera)
    np.testing.assert_array_equal(formats.read_camera(tmp_path / "again.json").readout, camera.readout)
    with pytest.raises(CameraError, match="readout is"):
        formats.read_camera(write(tmp_path / "camera.json", entries | {"readout": [0.0, 0.01, 0.02]}))
    with pytest.raises(CameraError, match="it is in seconds"):
        formats.read_camera(write(tmp_path / "camera.json", entries | {"readout": 20}))
