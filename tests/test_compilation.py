import math
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtri.compilation import Stable, capacity


@pytest.mark.parametrize(("count", "size"), [(0, 64), (1, 64), (64, 64), (65, 128), (800, 1024)])
def test_capacities_come_in_a_few_sizes(count, size):
    assert capacity(count) == size


def test_programs_are_kept_for_later_processes(tmp_path):
    """The second process compiles nothing; JAX's own setting goes first."""
    code = (
        "from pathlib import Path; import jax\n"
        "from jaxtri.compilation import keep_programs\n"
        "keep_programs(Path({0!r}))\n"
        "hits = []\n"
        "jax.monitoring.register_event_listener(lambda name, **_: hits.append(name))\n"
        "jax.jit(lambda x: x * 2 + 1)(1.0)\n"
        "print(sum(name.endswith('/cache_hits') for name in hits))\n"
    )
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")} | {"JAX_PLATFORMS": "cpu"}

    def run(**more):
        command = [sys.executable, "-c", code.format(str(ours))]
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment | more)
        return int(done.stdout)

    assert [run(), run() > 0] == [0, True]
    run(JAX_COMPILATION_CACHE_DIR=str(theirs), JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="0")
    assert any(theirs.iterdir())


def made(source="def f(x): return c * x", name="f", **around):
    """The function of that name, made anew among the variables `around`."""
    exec(source, around)
    return Stable(around[name])


CALLS = "def g(x): return {} * x\ndef f(x): return g(x)"
NESTED = "def f(x):\n    def g(y): return {} * y\n    return g(x)"
CLOSED = "def outer(c):\n    return lambda x: c * x\nf = outer({})"
JITTED = "import jax\n@jax.jit\ndef g(x): return {} * x\ndef f(x): return g(x)"
DEFAULT, KEYWORD = "def f(x, c={}): return c * x", "def f(x, *, c={}): return c * x"


@pytest.mark.parametrize("source", ["def f(x): return {} * x", CALLS, NESTED, CLOSED, JITTED, DEFAULT, KEYWORD])
def test_a_function_made_anew_is_the_same_until_what_it_does_changes(source):
    one, again, other = made(source.format(2)), made("\n" + source.format(2)), made(source.format(3))
    assert (one(7), again(7), other(7)) == (14, 14, 21)
    assert one == again
    assert hash(one) == hash(again)
    assert one != other
    assert one != made(source.format(2.0))  # what it is multiplied with has another type


@pytest.mark.parametrize(
    ("value", "other"),
    [
        (2, 3),
        (2, 2.0),
        (0.0, -0.0),
        ("two", "three"),
        (np.arange(3.0), np.array([0, 1, 2 + 1e-15])),
        (np.arange(3), np.arange(3, dtype=np.int32)),
        (jnp.ones(2), np.ones(2)),
        ({"a": [jnp.ones(2), 1]}, {"a": [jnp.ones(2), 2]}),
        ({"a": 1}, {"b": 1}),
        (np, jnp),
        (math.sin, math.cos),
        (os.path.join, os.path.split),
        (int, float),
    ],
)
def test_surroundings_count_by_value(value, other):
    """Arrays and their trees by what is in them; modules, classes and functions of other modules by identity."""
    copied = jax.tree.map(lambda x: x.copy() if isinstance(x, np.ndarray | jax.Array) else x, value)
    assert made(c=value) == made(c=copied)
    assert made(c=value) != made(c=other)
    assert made("def f(x): return x", c=value) == made("def f(x): return x", c=other)  # not named, not meant
    array = np.ones(2)
    before = made(c=array)
    array[0] = 2
    assert before != made(c=array)


def test_what_may_change_unseen_equals_itself_alone():
    class Box:
        value = 1

    one = made(c=Box())
    assert one == one
    assert made(c=one.function.__globals__["c"]) != one
    assert Stable(len) != Stable(max)


def test_surroundings_end_where_a_library_begins():
    """JAX's own module has a dictionary whose keys cannot be sorted: walked into, it ended in an error."""
    source = "import jax\nfrom jax import vmap\nh = jax.vmap(abs)\ndef f(x): return vmap(h)(x)"
    function = made(source).function
    assert Stable(function) == Stable(function)
