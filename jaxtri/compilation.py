"""Compile once: arrays of a few sizes, and programs kept for later runs."""

import hashlib
import math
import os
import platform
from pathlib import Path

import jax


def capacity(count: int) -> int:
    """The least of a few sizes that holds `count`, 64 and its doubles: what is compiled for it serves for less."""
    return 64 << max(0, math.ceil(math.log2(max(count, 1) / 64)))


def keep_programs(folder: Path | None = None) -> None:
    """Keep what is compiled from now on for later processes: JAX's persistent compilation cache.

    In `folder`, by default one of this processor under `XDG_CACHE_HOME` or `~/.cache`. JAX's own settings go first:
    `JAX_COMPILATION_CACHE_DIR` for another folder, `JAX_ENABLE_COMPILATION_CACHE=false` for none.
    """
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        jax.config.update("jax_compilation_cache_dir", str(folder or _default()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _default() -> Path:
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    # A home shared by several machines: what one processor runs another may not.
    return root / "jaxtri" / hashlib.sha256(_processor().encode()).hexdigest()[:12]


def _processor() -> str:
    described = [platform.machine(), platform.processor()]
    information = Path("/proc/cpuinfo")
    if information.is_file():
        lines = information.read_text(errors="replace").splitlines()
        described += [
            next((x for x in lines if x.startswith(kind)), "") for kind in ("model name", "flags", "Features")
        ]
    return "\n".join(described)
