"""Sequences with exact truth: the paper's synthetic experiment from a key, and a small renderer of scenes."""

from jaxtri.synthetic.experiment import Experiment, paper_experiment, steady_experiment
from jaxtri.synthetic.laboratory import Footage, blank_scene, laboratory, planar_scene
from jaxtri.synthetic.scene import Quad, Rendering, Scene, box, quad, render, rendered_sequence

__all__ = [
    "Experiment",
    "Footage",
    "Quad",
    "Rendering",
    "Scene",
    "blank_scene",
    "box",
    "laboratory",
    "paper_experiment",
    "planar_scene",
    "quad",
    "render",
    "rendered_sequence",
    "steady_experiment",
]
