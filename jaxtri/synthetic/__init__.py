"""Sequences with exact truth: the paper's synthetic experiment from a key, and a small renderer of scenes."""

from jaxtri.synthetic.laboratory import Footage, blank_scene, laboratory, planar_scene
from jaxtri.synthetic.scene import Quad, Rendering, Scene, box, quad, render, rendered_sequence

__all__ = [
    "Footage",
    "Quad",
    "Rendering",
    "Scene",
    "blank_scene",
    "box",
    "laboratory",
    "planar_scene",
    "quad",
    "render",
    "rendered_sequence",
]
