import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from jaxtri.errors import InputError
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.lenses import BrownConrady
from jaxtri.synthetic import Scene, blank_scene, box, laboratory, planar_scene, quad, render, rendered_sequence
from jaxtri.synthetic.textures import checks, plain

PINHOLE = Camera.from_parameters(300, 310, 158, 121, width=320, height=240)
BARREL = Camera.from_parameters(
    300, 310, 158, 121, distortion=BrownConrady.from_coefficients([-0.25, 0.06, 1e-3, -2e-3]), width=320, height=240
)
BLACK_WHITE = ((20, 20, 20), (235, 235, 235))


def pose(x=0.0, y=0.0, z=0.0, rx=0.0, ry=0.0, rz=0.0):
    return np.array(SE3.exp(jnp.array([x, y, z, rx, ry, rz])).as_matrix())


def project(camera, T, X):
    X = X @ T[:3, :3].T + T[:3, 3]
    return np.asarray(camera.to_pixels(jnp.asarray(X[..., :2] / X[..., 2:])))


@pytest.mark.parametrize("camera", [PINHOLE, BARREL], ids=["pinhole", "barrel"])
@pytest.mark.parametrize("T", [pose(), pose(0.4, 0.2, 0.4, 0.2, -0.3, 0.3)], ids=["front", "tilted"])
def test_corners_are_where_the_camera_says(camera, T):
    corner, u, v = np.array([-0.7, -0.5, 2.0]), np.array([1.4, 0, 0.1]), np.array([0, 1.0, -0.2])
    image = render(Scene((quad(corner, u, v, checks(600, 700, (6, 7), BLACK_WHITE)),)), camera, T).image
    grid = np.stack(np.meshgrid(np.arange(1, 7) / 7, np.arange(1, 6) / 6), -1).reshape(-1, 2)
    expected = project(camera, T, corner + grid @ np.array([u, v]))
    expected = expected[((expected > 6) & (expected < [313, 233])).all(axis=1)]
    assert len(expected) > 20
    found = cv2.cornerSubPix(
        cv2.cvtColor(image, cv2.COLOR_BGR2GRAY),
        expected.astype(np.float32)[:, None] + 0.4,
        (4, 4),
        (-1, -1),
        (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-4),
    )[:, 0]
    assert np.abs(found - expected).max() < 0.1
    assert np.abs((found - expected).mean(axis=0)).max() < 0.02


def test_depth_is_that_of_the_nearest_plane():
    wall = quad((-9, -9, 3.0), (18, 0, 0), (0, 18, 0), plain(2, 2, (50, 60, 70)))
    faces = [plain(2, 2, (40 * k, 0, 0)) for k in range(6)]
    cube = box((0.0, 0.1, 1.5), (0.4, 0.4, 0.4), 0.5, faces)
    T = pose(0.05, 0.1, 0.0, 0.1, 0.05, -0.2)
    depth = render(Scene((*cube, wall)), PINHOLE, T).depth
    # The slow twin: every ray against every face.
    v, u = np.mgrid[:240, :320]
    rays = np.stack([(u - 158) / 300, (v - 121) / 310, np.ones(u.shape)], -1)
    nearest = np.full(u.shape, np.inf)
    for q in (*cube, wall):
        a, b, c = T[:3, :3] @ q.edge_u, T[:3, :3] @ q.edge_v, T[:3, :3] @ q.corner + T[:3, 3]
        n = np.cross(a, b)
        z = (n @ c) / (rays @ n)
        inside = [((rays * z[..., None] - c) @ e) / (e @ e) for e in (a, b)]
        hit = (z > 0) & np.all([(s >= 0) & (s <= 1) for s in inside], axis=0)
        nearest = np.where(hit & (z < nearest), z, nearest)
    assert len(np.unique(nearest < 2)) == 2  # both are in view
    np.testing.assert_allclose(depth, nearest, rtol=1e-9)


def test_textures_finer_than_a_pixel_turn_to_their_mean():
    fine = checks(900, 900, (900, 900), ((0, 0, 0), (200, 200, 200)))
    scene = Scene((quad((-1, -1, 2.0), (2, 0, 0), (0, 2, 0), fine),))
    image = render(scene, PINHOLE, pose(rz=0.1)).image
    assert np.abs(image[60:180, 60:260].astype(int) - 100).max() <= 12


def test_an_outline_covers_part_of_a_pixel():
    scene = Scene((quad((-1, -1, 2.0), (2, 0, 0), (0, 0.995, 0), plain(2, 2, (200, 200, 200))),), (0, 0, 0))
    image = render(scene, PINHOLE, np.eye(4)).image  # its lower side is at v = 121 - 0.005 * 155
    np.testing.assert_allclose(image[119:123, 158, 0], [200, 150, 0, 0], atol=1)


def test_what_is_behind_or_turned_away_is_not_seen():
    texture = plain(2, 2, (200, 0, 0))
    for corner, u in [((-1, -1, -2.0), (2, 0, 0)), ((1, -1, 2.0), (-2, 0, 0))]:
        image, depth = render(Scene((quad(corner, u, (0, 2, 0), texture),)), PINHOLE, np.eye(4))
        assert (image == 96).all()
        assert np.isinf(depth).all()
    floor = quad((-50, 0.5, 50), (100, 0, 0), (0, 0, -100), texture)  # passes under the camera
    depth = render(Scene((floor,)), PINHOLE, np.eye(4)).depth
    np.testing.assert_allclose(depth[200, 100], 0.5 * 310 / (200 - 121))
    assert np.isinf(depth[:120]).all()


@pytest.fixture(scope="module")
def footage():
    return laboratory()


def test_laboratory_is_a_rig_sliding_sideways(footage):
    T = footage.T_world_camera
    assert T.shape == (100, 4, 4)
    np.testing.assert_allclose(T[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(T[-1, :3, 3], [0.495, 0, 0], atol=0.004)
    angles = jax.vmap(lambda t: SE3.from_matrix(t).rotation().log())(jnp.asarray(T))
    assert 0.1 < np.degrees(np.abs(np.asarray(angles))).max() < 1


def test_tracked_features_move_as_the_depth_and_the_poses_say(footage):
    scene, camera, _, T_world_camera = footage
    images = list(rendered_sequence(scene, camera, T_world_camera[[0, 8]], noise_gray=1.0))
    first, last = (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images)
    pixels = cv2.goodFeaturesToTrack(first, 300, 0.01, 8)[:, 0]
    depth = render(scene, camera, np.eye(4)).depth
    tracked, found, _ = cv2.calcOpticalFlowPyrLK(first, last, pixels, None)
    z = depth[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    xy = np.asarray(camera.to_normalised(jnp.asarray(pixels, camera.fx.dtype)))
    X = np.column_stack([xy, np.ones(len(xy))]) * z[:, None]
    error = tracked - project(camera, np.linalg.inv(T_world_camera[8]), X)
    assert found.sum() > 250
    assert np.linalg.norm(tracked - pixels, axis=1).mean() > 10
    assert np.median(np.linalg.norm(error, axis=1)) < 0.1
    assert np.abs(np.median(error, axis=0)).max() < 0.02


def test_degenerate_scenes():
    poses = np.stack([np.eye(4), pose(0.1)])
    for image in rendered_sequence(blank_scene(), PINHOLE, poses):
        assert image.std() == 0
    assert cv2.goodFeaturesToTrack(render(planar_scene(), PINHOLE, np.eye(4)).image[..., 1], 300, 0.01, 5).size > 200
    noisy = [next(rendered_sequence(blank_scene(), PINHOLE, poses, noise_gray=2.0, seed=s)) for s in (0, 0, 1)]
    assert noisy[0].std() == pytest.approx(2, rel=0.05)
    np.testing.assert_array_equal(noisy[0], noisy[1])
    assert (noisy[0] != noisy[2]).any()
    with pytest.raises(InputError, match="image size"):
        render(blank_scene(), Camera.from_parameters(300, 300, 160, 120), np.eye(4))
