"""Work in a thread of its own."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import jax

T = TypeVar("T")


def beside(function: Callable[[], T], name: str) -> Future[T]:
    """What the function returns, once the thread of this name has worked it out; by JAX as it is set here."""
    # What a `with` has set in JAX holds for the thread that says so alone.
    x64, device = jax.enable_x64.value, jax.default_device.value

    def run() -> T:
        with jax.enable_x64(x64), jax.default_device(device):
            return function()

    pool = ThreadPoolExecutor(1, thread_name_prefix=name)
    found = pool.submit(run)
    pool.shutdown(wait=False)
    return found
