import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# One thread an operation: with two test workers on two cores, more only makes them wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "agg")

from jaxtyping import install_import_hook

with install_import_hook("jaxtri", "beartype.beartype"):
    import jaxtri  # noqa: F401

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture
def key():
    return jax.random.key(0)
