"""Fields of the public classes: documented where `help()` shows them, and arrays whatever number they are given."""

import dataclasses
import inspect
import re

import jax
import jax.numpy as jnp
import pytest

import jaxtri
from jaxtri.models.baselines.two_step import KnownStructure

CLASSES = [x for name in jaxtri.__all__ if inspect.isclass(x := getattr(jaxtri, name))]
WITH_FIELDS = [c for c in CLASSES if dataclasses.is_dataclass(c) or hasattr(c, "_fields")]
NOISES = 1e-3, 0.01, 0.02
MODELS = [
    jaxtri.BaseFrames(*NOISES),
    jaxtri.BasePairs(*NOISES),
    jaxtri.RollingShutter(*NOISES),
    jaxtri.Depth(1e-3, 1e-3, 0, jnp.inf),
    KnownStructure(*NOISES),
    jaxtri.StructureAndMotion(*NOISES),
    jaxtri.Trifocal(*NOISES, 0.0, jnp.array([0.1, 0.0, 0.0])),
]


@pytest.mark.parametrize("kind", WITH_FIELDS, ids=lambda kind: kind.__name__)
def test_every_field_is_documented(kind):
    names = kind._fields if hasattr(kind, "_fields") else [f.name for f in dataclasses.fields(kind)]
    described = re.findall(r"^    (\w+): ", inspect.getdoc(kind) or "", re.MULTILINE)
    assert {n for n in names if not n.startswith("_")} <= set(described)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: type(model).__name__)
def test_a_model_of_floats_is_one_of_arrays(model):
    for told in (model, dataclasses.replace(model, sigma=2e-3)):
        assert all(isinstance(x, jax.Array) and not x.weak_type for x in jax.tree.leaves(told))
    assert model.normalised


def test_numbers_of_cameras_and_settings_become_arrays():
    camera = jaxtri.Camera.from_fov(65, 640, 480)
    assert isinstance(dataclasses.replace(camera, fx=500.0).fx, jax.Array)
    settings = dataclasses.replace(jaxtri.Settings.of(camera), sigma=1e-3, minimum=10)
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(settings))
