"""Point clouds: PLY."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Shaped, UInt8

from jaxtri.errors import InputError
from jaxtri.formats.files import PathLike, atomic_write


def write_ply(
    path: PathLike,
    points: Shaped[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"] | None = None,
    extra: Mapping[str, Shaped[np.ndarray, " n"]] | None = None,
) -> None:
    """Write a point cloud as binary PLY: positions, colours (RGB) and named scalars, as 32-bit floats."""
    columns = {name: np.asarray(points)[:, i] for i, name in enumerate("xyz")}
    fields = [(name, "<f4", "float") for name in columns]
    if colours is not None:
        names = ("red", "green", "blue")
        columns |= {name: colours[:, i] for i, name in enumerate(names)}
        fields += [(name, "u1", "uchar") for name in names]
    for name, value in (extra or {}).items():
        if not name.isidentifier() or name in columns:
            raise InputError(f"PLY property {name!r}: a name must be one new word (not x, red, ...)")
        columns[name] = np.asarray(value)
        fields.append((name, "<f4", "float"))
    vertices = np.empty(len(points), [(name, kind) for name, kind, _ in fields])
    for name, value in columns.items():
        if value.shape != vertices.shape:
            raise InputError(f"PLY property {name!r} has shape {value.shape}; expected {vertices.shape}")
        vertices[name] = value
    properties = "".join(f"property {kind} {name}\n" for name, _, kind in fields)
    with atomic_write(path, "wb") as file:
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
        file.write(head.encode("ascii"))
        file.write(vertices.tobytes())
