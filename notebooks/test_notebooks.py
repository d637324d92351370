"""Runs every notebook from top to bottom, those that can in a short form; the outputs that are kept are not touched."""

import os
from importlib.metadata import version
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

HERE = Path(__file__).parent

os.environ["JAXTRI_SHORT"] = "1"  # read by the notebooks, which inherit it
if version("jaxlib").startswith("0.10."):  # compiles faster; an unknown flag would end the process
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")


@pytest.mark.parametrize("path", sorted(HERE.glob("*.ipynb")), ids=lambda p: p.stem)
@pytest.mark.filterwarnings("ignore")
def test_runs(path):
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=1200, resources={"metadata": {"path": str(HERE)}}).execute()
