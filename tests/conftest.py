import importlib
import os
import pkgutil
from importlib.metadata import version

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# One thread an operation: with two test workers on two cores, more only makes them wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "agg")
os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"  # the command line's, in the home of whoever runs the tests

# JAXTRI_AS_USERS=1: what users have, programs that are optimised and annotations that nobody checks.
if os.environ.get("JAXTRI_AS_USERS") != "1":
    # The suite spends its time compiling, not computing.
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    if version("jaxlib").startswith("0.10."):  # an unknown flag would end the process
        os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")

    from jaxtyping import install_import_hook

    # The numeric tower: an int may stand where a float is asked for, as Python has it.
    with install_import_hook("jaxtri", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"):
        import jaxtri

        # All of it: what is loaded later would not be checked.
        for module in pkgutil.walk_packages(jaxtri.__path__, "jaxtri."):
            importlib.import_module(module.name)

import jax
import pytest

jax.config.update("jax_enable_x64", True)
# Strict promotion is not to be had: jaxlie multiplies its integer tables with floats.


@pytest.fixture(autouse=True, scope="module")
def forget():
    """Compiled programs are let go of with each file: each has some of the process's maps, and Linux gives 65,530."""
    yield
    jax.clear_caches()


@pytest.fixture
def key():
    return jax.random.key(0)


@pytest.fixture
def compiled() -> list[float]:
    """Seconds of every program that XLA compiles from here on; JAX has no door to stop listening by, nor need it."""
    seconds: list[float] = []

    def heard(name: str, duration: float, **_: object) -> None:
        if name.endswith("/backend_compile_duration"):
            seconds.append(duration)

    jax.monitoring.register_event_duration_secs_listener(heard)
    return seconds
