"""What is saved comes back as it was: values, types and structure; what cannot be read says why."""

import dataclasses
import enum
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from jaxtri import Belief, Kinematics, Robust, Settings, Twist, load, save
from jaxtri.errors import InputError
from jaxtri.geometry.camera import Camera
from jaxtri.geometry.lenses import BrownConrady
from jaxtri.odometry.settings import Base, Status


class Pair(NamedTuple):
    a: Any
    b: Any


@dataclasses.dataclass
class Mine:
    values: Any
    kept: int = 3
    lost: Any = dataclasses.field(default=None, metadata={"saved": False})


class Colour(enum.Enum):
    RED = "red"


class Module(eqx.Module):
    x: jax.Array
    n: int = eqx.field(static=True, default=2)


ZERO = jnp.zeros(3)
CAMERA = Camera.from_parameters(
    500, 510, 320, 240, width=640, height=480, distortion=BrownConrady.from_coefficients([0.1])
)


@pytest.mark.parametrize(
    "thing",
    [
        None,
        True,
        3,
        "a word",
        float("inf"),
        [1, (2.5, "x"), {"k": np.arange(3), "none": None}],
        np.arange(6, dtype=np.int16).reshape(2, 3),
        jnp.arange(3.0),
        Status.LOST,
        Base.PAPER,
        Belief(Kinematics(ZERO, ZERO, ZERO, ZERO), jnp.eye(12)),
        Belief(Twist(SE3.identity(), jnp.zeros(6)), jnp.eye(12, dtype=jnp.float32)),
        CAMERA,
        Settings.of(CAMERA),
        Robust(),
        {"file": np.zeros(2), "tree": np.ones(2), "allow_pickle": 1},
        {"a/b": np.zeros(1), "a": {"b": np.ones(1)}},
    ],
    ids=str,
)
def test_it_comes_back_as_it_was(thing, tmp_path):
    save(tmp_path / "x.npz", thing)
    back = load(tmp_path / "x.npz")
    assert type(back) is type(thing)
    assert jax.tree.structure(back) == jax.tree.structure(thing)
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(thing), strict=True):
        assert type(a) is type(b)
        assert np.asarray(a).dtype == np.asarray(b).dtype
        np.testing.assert_array_equal(a, b)


def test_numpy_reads_it_under_the_names_of_the_fields(tmp_path):
    save(tmp_path / "x.npz", Belief(Twist(SE3.identity(), jnp.arange(6.0)), jnp.eye(12)))
    with np.load(tmp_path / "x.npz") as file:
        assert set(file.files) == {"tree", "covariance", "mean/pose/wxyz_xyz", "mean/twist"}
        np.testing.assert_array_equal(file["mean/twist"], np.arange(6.0))


def test_classes_of_others_have_to_be_given(tmp_path):
    path = tmp_path / "x.npz"
    save(path, [Mine(Pair(jnp.ones(2), Colour.RED), 5, lost=object()), Module(jnp.zeros(1), 7)])
    with pytest.raises(InputError, match=r"holds a .*Mine: give the class, load\(path, types=\[Mine\]\)"):
        load(path)
    mine, module = load(path, types=[Mine, Pair, Colour, Module])
    assert (mine.kept, mine.lost, mine.values.b, module.n) == (5, None, Colour.RED, 7)
    np.testing.assert_array_equal(mine.values.a, 1)


def test_what_cannot_be_saved_leaves_the_file_as_it_was(tmp_path):
    path = tmp_path / "x.npz"
    save(path, 1)
    with pytest.raises(InputError, match="b/0 is a object, which cannot be saved"):
        save(path, {"a": 1, "b": [object()]})
    assert load(path) == 1
    assert list(tmp_path.iterdir()) == [path]


def test_a_nan_and_an_empty_list_survive(tmp_path):
    save(tmp_path / "x.npz", [float("nan"), [], (), {}, np.zeros((0, 3))])
    nan, *rest, empty = load(tmp_path / "x.npz")
    assert np.isnan(nan)
    assert rest == [[], (), {}]
    assert empty.shape == (0, 3)


def test_files_that_are_none_say_so(tmp_path):
    (tmp_path / "text.npz").write_text("no archive")
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    for name in ("text.npz", "other.npz", "missing.npz"):
        with pytest.raises(InputError, match="cannot be read as an archive"):
            load(tmp_path / name)
    tree = np.frombuffer(b'{"format": 99, "root": null}', np.uint8)
    np.savez(tmp_path / "new.npz", tree=tree)
    with pytest.raises(InputError, match="is of format 99; this version reads 1"):
        load(tmp_path / "new.npz")
    tree = np.frombuffer(b'{"format": 1, "root": {"enum": "os:system", "value": "ls"}}', np.uint8)
    np.savez(tmp_path / "evil.npz", tree=tree)
    with pytest.raises(InputError, match="give the class"):
        load(tmp_path / "evil.npz")


def test_double_precision_wants_a_jax_that_has_it(tmp_path):
    save(tmp_path / "x.npz", jnp.ones(2))
    with jax.enable_x64(False), pytest.raises(InputError, match="jax_enable_x64"):
        load(tmp_path / "x.npz")


def test_paths_may_be_strings(tmp_path):
    save(str(tmp_path / "folder" / "x.npz"), 1)
    assert load(Path(tmp_path) / "folder" / "x.npz") == 1
