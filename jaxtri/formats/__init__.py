"""Files in and out, a file a kind; every one is written as a whole or not at all. No images, no filters."""

from jaxtri.formats.cameras import read_camera, write_camera
from jaxtri.formats.clouds import write_ply
from jaxtri.formats.files import atomic_path, atomic_write, write_json
from jaxtri.formats.times import read_timestamps
from jaxtri.formats.trajectories import (
    read_euroc,
    read_kitti,
    read_trajectory,
    read_tum,
    write_euroc,
    write_kitti,
    write_tum,
)

__all__ = [
    "atomic_path",
    "atomic_write",
    "read_camera",
    "read_euroc",
    "read_kitti",
    "read_timestamps",
    "read_trajectory",
    "read_tum",
    "write_camera",
    "write_euroc",
    "write_json",
    "write_kitti",
    "write_ply",
    "write_tum",
]
