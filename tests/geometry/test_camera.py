import cv2
import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtri.errors import CameraError
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.lenses import BrownConrady, DoubleSphere, ExtendedUnified, FieldOfView, Fisheye

WIDE = BrownConrady.from_coefficients([-0.2966812740489896, 0.08085690919870842])
FULL = BrownConrady.from_coefficients([0.3, -0.2, 1e-3, -2e-3, 0.05, 0.35, -0.1, 0.02])
FISHEYE = Fisheye.from_coefficients([-0.02, 0.01, -0.004, 0.0006])
PRISM = BrownConrady.from_coefficients([0.3, -0.2, 1e-3, -2e-3, 0.05, 0.35, -0.1, 0.02, 2e-3, -1e-3, -3e-3, 5e-4])
FOV = FieldOfView.from_coefficients([0.93])
DS = DoubleSphere.from_coefficients([-0.21, 0.58])
EUCM = ExtendedUnified.from_coefficients([0.6, 1.1])
FOLD = BrownConrady.from_coefficients([-0.3])  # at a radius of 1.054 the image turns back
SIZE = {"width": 752, "height": 480}

# One compilation for each kind of camera, shared by all the tests.
to_pixels = jax.jit(Camera.to_pixels)
to_normalised = jax.jit(Camera.to_normalised)


def camera(distortion, skew=0.0, dtype=None):
    return Camera.from_parameters(420.5, 421.7, 355.2, 250.3, skew=skew, distortion=distortion, dtype=dtype, **SIZE)


def pixel_grid():
    u, v = np.meshgrid(np.linspace(0, 751, 24), np.linspace(0, 479, 16))
    return np.stack([u, v], -1)


def ray_grid(degrees):
    angle, turn = np.meshgrid(np.radians(np.linspace(0, degrees, 24)), np.linspace(0, 6, 16))
    return np.tan(angle)[..., None] * np.stack([np.cos(turn), np.sin(turn)], -1)


@pytest.mark.parametrize("distortion", [None, WIDE, FULL, PRISM])
def test_pinhole_agrees_with_opencv_both_ways(distortion):
    cam = camera(distortion)
    K = np.asarray(cam.K)
    coefficients = None if distortion is None else np.asarray(distortion.coefficients)
    pixels = pixel_grid()
    criteria = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    arguments = pixels.reshape(-1, 1, 2), K, coefficients
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
        expected = cv2.undistortPointsIter(*arguments, None, None, criteria)
    else:
        expected = cv2.undistortPoints(*arguments, criteria=criteria)
    normalised = np.asarray(to_normalised(cam, jnp.asarray(pixels)))
    np.testing.assert_allclose(normalised.reshape(-1, 2), expected[:, 0], atol=1e-8)
    X = np.concatenate([normalised, np.ones((16, 24, 1))], -1).reshape(-1, 1, 3)
    projected = cv2.projectPoints(X, np.zeros(3), np.zeros(3), K, coefficients)[0]
    back = to_pixels(cam, jnp.asarray(normalised))
    np.testing.assert_allclose(back, projected.reshape(16, 24, 2), atol=1e-9)


def test_fisheye_with_skew_agrees_with_opencv_both_ways():
    K, k = np.asarray(camera(FISHEYE).K), np.asarray(FISHEYE.coefficients)
    X = np.concatenate([ray_grid(80), np.ones((16, 24, 1))], -1).reshape(-1, 1, 3)
    pixels = cv2.fisheye.projectPoints(X, np.zeros(3), np.zeros(3), K, k, alpha=3.0 / 420.5)[0]
    ours = to_pixels(camera(FISHEYE, skew=3.0), jnp.asarray(ray_grid(80)))
    np.testing.assert_allclose(ours, pixels.reshape(16, 24, 2), atol=1e-9)
    pixels = cv2.fisheye.projectPoints(X, np.zeros(3), np.zeros(3), K, k)[0]
    expected = cv2.fisheye.undistortPoints(pixels, K, k, criteria=(3, 100, 1e-15))
    back = to_normalised(camera(FISHEYE), jnp.asarray(pixels.reshape(16, 24, 2)))
    np.testing.assert_allclose(back, expected.reshape(16, 24, 2), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("distortion", [None, WIDE, FULL, PRISM, FISHEYE, FOV, DS, EUCM])
def test_round_trip_of_the_whole_image(distortion):
    cam = camera(distortion, skew=-7.0)
    pixels = jnp.asarray(pixel_grid())
    if distortion in (FISHEYE, FOV, DS, EUCM):
        pixels = to_pixels(cam, jnp.asarray(ray_grid(89)))
    back = to_pixels(cam, to_normalised(cam, pixels))
    assert np.abs(np.asarray(back) - np.asarray(pixels)).max() < 1e-9
    assert jax.eval_shape(to_normalised, cam, jax.ShapeDtypeStruct((2,), jnp.float64)).shape == (2,)


@pytest.mark.parametrize("distortion", [FULL, PRISM, FISHEYE, FOV, DS, EUCM])
def test_derivatives_of_every_leaf_are_those_of_central_differences(distortion):
    cam = camera(distortion, skew=2.0)
    pixels = pixel_grid()
    pixels[3, 5] = 355.2, 250.3  # the image centre, where r is 0
    leaves, unravel = jax.flatten_util.ravel_pytree(cam)
    at = [np.asarray(leaves), pixels, np.asarray(to_normalised(cam, jnp.asarray(pixels)))]

    def both(leaves, pixels, normalised):
        cam = unravel(jnp.asarray(leaves))
        return to_normalised(cam, jnp.asarray(pixels)), to_pixels(cam, jnp.asarray(normalised))

    @jax.jit
    def derivatives(at, directions, weights):
        _, forward = jax.linearize(both, *at)
        return forward(*directions), jax.linear_transpose(forward, *at)(weights)

    rng = np.random.default_rng(0)
    weights = tuple(rng.normal(size=(2, *pixels.shape)))
    # Each leaf by itself, then every pixel and every normalised point at once.
    directions = [(unit, 0 * pixels, 0 * pixels) for unit in np.eye(len(leaves))]
    directions += [(0 * at[0], rng.normal(size=pixels.shape), 1e-3 * rng.normal(size=pixels.shape))]
    for direction in directions:
        h = 1e-6 * max(1.0, abs(direction[0] @ at[0]))
        pushed, pulled = derivatives(at, direction, weights)
        plus, minus = (both(*(a + step * d for a, d in zip(at, direction, strict=True))) for step in (h, -h))
        for exact, p, m, atol in zip(pushed, plus, minus, (1e-9, 1e-6), strict=True):
            np.testing.assert_allclose(exact, (np.asarray(p) - np.asarray(m)) / (2 * h), rtol=1e-6, atol=atol)
        dots = [
            sum(np.vdot(a, b) for a, b in zip(*pair, strict=True)) for pair in ((pulled, direction), (pushed, weights))
        ]
        np.testing.assert_allclose(*dots, rtol=1e-9)


def test_float32_is_kept_close_and_finite_for_wild_points():
    @jax.jit
    def run(cam, points):
        def function(cam, points):
            return cam.to_pixels(points), cam.to_normalised(points)

        values, pull = jax.vjp(function, cam, points)
        return values, pull(jax.tree.map(jnp.ones_like, values))

    points = pixel_grid().astype(np.float32)
    points[-1, :6] = [[0, 0], [1, 0], [3, 4], [-70, 1e-30], [1e6, -1e6], [1e30, -1e30]]
    pole = BrownConrady.from_coefficients([0, 0, 0, 0, 0, -1.0])
    # Lenses at the ends of what they may be: nothing but a pinhole, and a pole before the image.
    ends = [FieldOfView.from_coefficients([x]) for x in (0.0, 3.14)]
    ends += [DoubleSphere.from_coefficients(x) for x in ((-0.9, 0.1), (0.0, 0.0), (0.9, 1.0))]
    ends += [ExtendedUnified.from_coefficients(x) for x in ((0.0, 1.0), (1.0, 1e-6))]
    for distortion in (FOLD, pole, FULL, PRISM, FISHEYE, FOV, DS, EUCM, *ends):
        values, gradients = run(camera(distortion, dtype=jnp.float32), jnp.asarray(points))
        for leaf in jax.tree.leaves((values, gradients)):
            assert leaf.dtype == jnp.float32
            assert np.isfinite(leaf).all()
        if distortion in (FULL, PRISM, FISHEYE):
            back = to_pixels(camera(distortion, dtype=jnp.float32), values[1])
            assert np.abs(np.asarray(back) - points)[:-1].max() < 1e-3


def test_lenses_are_those_of_their_papers():
    """By the points of space that the papers project: the angle of Devernay, the spheres of Usenko and Khomutenko."""
    xy = ray_grid(88)
    X = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], -1)
    r = np.linalg.norm(xy, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        fov = np.where(r > 0, xy / r * np.arctan(2 * r * np.tan(0.93 / 2)) / 0.93, 0)
    on_first = X / np.linalg.norm(X, axis=-1, keepdims=True)
    on_second = on_first + np.array([0, 0, -0.21])
    on_second /= np.linalg.norm(on_second, axis=-1, keepdims=True)
    ds = on_second[..., :2] / (0.58 + (1 - 0.58) * on_second[..., 2:])
    eucm = xy / (0.6 * np.sqrt(1.1 * r**2 + 1) + 0.4)
    for lens, expected in ((FOV, fov), (DS, ds), (EUCM, eucm)):
        pixels = to_pixels(camera(lens), jnp.asarray(xy))
        np.testing.assert_allclose(pixels, expected * [420.5, 421.7] + [355.2, 250.3], rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize(
    "distortion", [None, FULL, PRISM, FISHEYE, FOV, DS, EUCM, FieldOfView.from_coefficients([1e-3])]
)
def test_the_magnification_is_the_slope_at_the_centre(distortion):
    cam = camera(distortion)
    slope = jax.jacfwd(cam.to_pixels)(jnp.zeros(2))
    np.testing.assert_allclose(slope, cam.magnification * np.diag([420.5, 421.7]), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(cam.focal**2, np.linalg.det(slope))


@pytest.mark.parametrize("size", [(376, 240), (1504, 960), (250, 160), (251, 160)])
def test_a_scaled_camera_sees_the_same_picture(size):
    cam = camera(FULL, skew=3.0)
    scaled = cam.scaled(*size)
    xy = jnp.asarray(ray_grid(30))
    share = (np.asarray(to_pixels(cam, xy)) + 0.5) / [752, 480]
    np.testing.assert_allclose((np.asarray(to_pixels(scaled, xy)) + 0.5) / size, share, rtol=1e-12)
    assert (scaled.width, scaled.height) == size
    with pytest.raises(CameraError, match="cropped or stretched"):
        cam.scaled(640, 480)


@pytest.mark.parametrize("distortion", [None, FULL, PRISM, FISHEYE, FOV, DS, EUCM])
def test_a_turned_camera_sees_the_turned_picture(distortion):
    cam, xy = camera(distortion), jnp.asarray(ray_grid(30))
    u, v = np.moveaxis(np.asarray(to_pixels(cam, xy)), -1, 0)
    x, y = xy[..., 0], xy[..., 1]
    for degrees, ray, pixel in (
        (90, (-y, x), (479 - v, u)),
        (180, (-x, -y), (751 - u, 479 - v)),
        (270, (y, -x), (v, 751 - u)),
    ):
        turned = cam.turned(degrees)
        np.testing.assert_allclose(turned.to_pixels(jnp.stack(ray, -1)), np.stack(pixel, -1), rtol=1e-12, atol=1e-9)
        assert (turned.width, turned.height) == ((752, 480) if degrees == 180 else (480, 752))
        assert eqx.tree_equal(turned.turned(-degrees), cam, rtol=1e-14)
    jax.jit(lambda c: c.turned(90))(cam)


def test_what_cannot_be_turned_is_named():
    cam = camera(FULL, skew=3.0)
    with pytest.raises(CameraError, match="skew is 3"):
        cam.turned(90)
    assert cam.turned(180).skew == 3
    with pytest.raises(CameraError, match="cannot be turned by 45"):
        cam.turned(45)
    with pytest.raises(CameraError, match="set its width and height"):
        Camera.from_parameters(500, 500, 320, 240).turned(90)
    with pytest.raises(CameraError, match=r"turned\(90\) or turned\(270\)"):
        cam.scaled(240, 376)


def test_beyond_the_fold_the_answer_is_the_fold_on_the_same_side():
    pixels = np.full((16, 24, 2), [1e4, 250.3])
    pixels[0, 0, 0] = -1e4
    outside = np.asarray(to_normalised(camera(FOLD), jnp.asarray(pixels)))
    np.testing.assert_allclose(outside[0, :2, 0], [-1.054, 1.054], atol=0.02)


def test_from_fov():
    cam = Camera.from_fov(90.0, 640, 480)
    np.testing.assert_allclose(cam.to_normalised(jnp.asarray([[-0.5, 239.5], [639.5, 239.5]]))[:, 0], [-1, 1])
    np.testing.assert_allclose(cam.K @ jnp.asarray([1.0, 0.75, 1.0]), [639.5, 479.5, 1.0])


@pytest.mark.parametrize("name", ["fx", "fy", "cx", "cy", "skew", "width", "height"])
@pytest.mark.parametrize("value", [0.0, -3.0, float("nan"), float("inf")])
def test_bad_parameter_is_named(name, value):
    good = {"fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0, "width": 640, "height": 480}
    if name in ("width", "height"):
        value = 0 if value == 0 else -3
    elif name not in ("fx", "fy") and np.isfinite(value):
        Camera.from_parameters(**(good | {name: value}))  # zero and negative are fine here
        return
    with pytest.raises(CameraError, match=name):
        Camera.from_parameters(**(good | {name: value}))


def test_bad_distortions_and_fields_of_view():
    with pytest.raises(CameraError, match="tilt"):
        BrownConrady.from_coefficients([0.1] * 14)
    with pytest.raises(CameraError, match=r"omega is 3\.2"):
        FieldOfView.from_coefficients([3.2])
    with pytest.raises(CameraError, match="xi is -1"):
        DoubleSphere.from_coefficients([-1.0, 0.5])
    with pytest.raises(CameraError, match="beta is 0"):
        ExtendedUnified.from_coefficients([0.5, 0.0])
    assert BrownConrady.from_coefficients([0.1] * 4 + [0.0] * 10).coefficients.shape == (8,)
    with pytest.raises(CameraError, match="model has 4"):
        Fisheye.from_coefficients([0.1] * 5)
    with pytest.raises(CameraError, match="distortion"):
        camera(Fisheye.from_coefficients([float("nan")]))
    with pytest.raises(CameraError, match="fov_deg"):
        Camera.from_fov(180.0, 640, 480)
