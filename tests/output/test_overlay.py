import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SO3

from jaxtri.errors import InputError
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.lenses import BrownConrady
from jaxtri.output.overlay import Wireframe, car, dominant_plane, draw_text, draw_wireframe, place

SIZE = {"width": 320, "height": 240}
PINHOLE = Camera.from_parameters(250, 260, 158, 121, **SIZE)
# Without k2 this polynomial turns back at |x| = 1.05 and is zero at 1.8: far points would fold into the image.
BARREL = Camera.from_parameters(
    250, 260, 158, 121, distortion=BrownConrady.from_coefficients([-0.3, 0, 1e-3, -2e-3]), **SIZE
)
CAMERAS = pytest.mark.parametrize("camera", [PINHOLE, BARREL], ids=["pinhole", "barrel"])
COLOUR = (0, 250, 0)


def draw(camera, wireframe, T_world_object=None, T_camera_world=None):
    eye, black = np.eye(4), np.zeros((240, 320, 3), np.uint8)
    T = [eye if t is None else t for t in (T_camera_world, T_world_object)]
    return draw_wireframe(black, camera, *T, wireframe, colour=COLOUR)[..., 1]


def segment(a, b):
    return Wireframe(np.array([a, b], float), np.array([[0, 1]]))


def project(camera, X):
    return np.asarray(camera.to_pixels(jnp.asarray(X[:, :2] / X[:, 2:])))


def near(pixels, others):
    """Distance from each of the other pixels (u, v) to the nearest of the pixels, all rounded."""
    mask = np.ones((240, 320), np.uint8)
    u, v = np.round(pixels).astype(int).T
    inside = (u >= 0) & (u < 320) & (v >= 0) & (v < 240)
    mask[v[inside], u[inside]] = 0
    u, v = np.round(others).astype(int).T
    return cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[v, u]


def drawn(image):
    return np.argwhere(image > 100)[:, ::-1]


@CAMERAS
def test_the_car_is_drawn_where_the_camera_sees_it(camera):
    R = np.array(SO3.exp(jnp.array([1.4, 0.5, 0.3])).as_matrix())
    T_object, T_camera = np.eye(4), np.eye(4)
    T_object[:3, :3], T_object[:3, 3] = 0.8 * R, [0.2, 0.1, 1.5]
    T_camera[:3, 3] = [-0.1, 0.05, 0.1]
    wireframe = car()
    assert np.ptp(wireframe.vertices, axis=0)[0] == pytest.approx(1)
    assert wireframe.vertices[:, 2].min() == pytest.approx(0, abs=1e-12)  # it stands on the ground
    image = draw(camera, wireframe, T_object, T_camera)
    X = wireframe.vertices @ (0.8 * R).T + [0.1, 0.15, 1.6]
    expected = project(camera, X)
    assert ((expected > 0) & (expected < [320, 240])).all()
    assert near(drawn(image), expected).max() < 1
    share = np.linspace(0, 1, 40)[:, None, None]
    lines = X[wireframe.edges[:, 0]] * (1 - share) + X[wireframe.edges[:, 1]] * share
    assert near(project(camera, lines.reshape(-1, 3)), drawn(image)).max() < 3


@CAMERAS
def test_what_is_behind_leaves_no_trace(camera):
    T = np.eye(4)
    T[2, 3] = -2
    assert draw(camera, car(), T).max() == 0


@CAMERAS
@pytest.mark.parametrize(
    ("a", "b"),
    [((-0.1, 0.3, 3.0), (-0.1, 0.3, -1.0)), ((-9, -0.2, 1.0), (9, 0.3, 1.0)), ((-2, 1, -1.0), (0.5, -0.2, 1.5))],
    ids=["through the image plane", "across", "past the camera"],
)
def test_a_cut_edge_shows_its_part_in_view_and_nothing_else(camera, a, b):
    share = np.linspace(0, 1, 3001)[:, None]
    X = np.array(a) * (1 - share) + np.array(b) * share
    X = X[X[:, 2] > 0.01]
    xy = X[:, :2] / X[:, 2:]
    X = X[(np.abs(xy) < 1.0).all(axis=1)]  # before the distortion folds
    truth = project(camera, X)
    truth = truth[((truth > 3) & (truth < [316, 236])).all(axis=1)]
    marked = drawn(draw(camera, segment(a, b)))
    assert near(truth, marked).max() < 5
    assert near(marked, truth).max() < 1.5


def test_the_plane_of_a_table_among_outliers():
    rng = np.random.default_rng(1)
    normal = np.array([0.1, -0.95, -0.3]) / np.linalg.norm([0.1, -0.95, -0.3])
    basis = np.linalg.svd(normal[None])[2][1:]
    on = np.array([0, 0.5, 2.0]) + rng.uniform(-0.6, 0.6, (120, 2)) @ basis
    on += 0.002 * rng.normal(size=on.shape)
    above = on[:60] + rng.uniform(0.1, 0.8, (60, 1)) * normal  # things that stand on it
    points = np.concatenate([on, above])
    for up in (None, np.array([0, -1.0, 0])):
        plane = dominant_plane(points, np.zeros(3), up=up)
        assert np.degrees(np.arccos(plane.normal @ normal)) < 1  # towards the camera, too
        assert abs((plane.point - [0, 0.5, 2.0]) @ normal) < 0.01
        assert plane.inliers[:120].mean() > 0.97
        assert plane.inliers[120:].mean() < 0.1
    with pytest.raises(InputError, match="three"):
        dominant_plane(points[:2], np.zeros(3))
    with pytest.raises(InputError, match="line"):
        dominant_plane(np.linspace(0, 1, 9)[:, None] * [1.0, 2.0, 3.0] + [0, 0, 1.0], np.zeros(3))


@pytest.mark.parametrize("wall", [False, True], ids=["floor", "wall"])
def test_the_car_stands_on_the_plane_at_the_pixel(wall):
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-1, 1, (2, 200))
    points = np.column_stack([u, v, 2 + 0 * u] if wall else [u, 0.6 + 0 * u, 2 + v])
    T_world_camera = np.eye(4)
    T_world_camera[:3, 3] = [0.05, 0.0, -0.2]
    T_camera_world = np.linalg.inv(T_world_camera)
    for pixel in [None, (150.0, 190.0)]:
        T = place(points, T_world_camera, PINHOLE, pixel=pixel)
        scale = np.cbrt(np.linalg.det(T[:3, :3]))
        np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], scale**2 * np.eye(3), atol=1e-9)
        up = T[:3, 2] / scale
        np.testing.assert_allclose(up, [0, 0, -1] if wall else [0, -1, 0], atol=1e-6)
        foot = project(PINHOLE, (T_camera_world @ T[:, 3])[None, :3])[0]
        if pixel is None:
            assert np.linalg.norm(foot - [160, 120 if wall else 170]) < 50
        else:
            np.testing.assert_allclose(foot, pixel, atol=1e-6)
        vertices = (T_camera_world @ T @ np.column_stack([car().vertices, np.ones(len(car().vertices))]).T)[:3].T
        assert 0.17 < np.ptp(project(PINHOLE, vertices)[:, 0]) / 320 < 0.4
    with pytest.raises(InputError, match="outside"):
        place(points, T_world_camera, PINHOLE, pixel=(500.0, 10.0))


def test_text_is_written_on_a_copy():
    image = np.full((240, 320, 3), 90, np.uint8)
    assert (draw_text(image, "frame 7")[200:] != 90).any()
    assert (image == 90).all()
