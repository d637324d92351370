import ast
import subprocess
import sys
from pathlib import Path

import jaxtri

PACKAGE = Path(jaxtri.__file__).parent


def imports(path: Path) -> set[str]:
    """Modules that a file names in an import, at the top or within a function."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module or "")
    return found


def test_the_core_loads_without_opencv_or_matplotlib():
    code = (
        "import sys, jaxtri\n"
        "for name in ('filters.ekf', 'models.trifocal', 'estimation.two_view', 'formats', 'synthetic', 'trajectory'):\n"
        "    __import__('jaxtri.' + name)\n"
        "print(sorted({'cv2', 'matplotlib', 'tqdm', 'tyro'} & set(sys.modules)))\n"
        "import jax; print(jax.config.jax_enable_x64)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", "False"], done.stdout + done.stderr


def test_imports_point_one_way():
    files = {p.relative_to(PACKAGE).as_posix(): imports(p) for p in PACKAGE.rglob("*.py")}
    for name, modules in files.items():
        ours = {m for m in modules if m.split(".")[0] == "jaxtri"}
        assert not any(m.startswith("jaxtri.cli") for m in ours), name
        if name in ("ekf.py", "moments.py", "scan.py"):
            assert ours <= {"jaxtri", "jaxtri.errors", "jaxtri.filters.projective", "jaxtri.filters.scan"}, (name, ours)
        if name.startswith("geometry/"):
            assert all(m.startswith("jaxtri.geometry") or m == "jaxtri.errors" for m in ours), (name, ours)
        if "cv2" in modules:
            assert name.startswith("vision/") or name in ("formats/cameras.py", "synthetic/rendered.py"), name
        if name.startswith("synthetic/"):
            assert not any(m.startswith("jaxtri.vision") for m in ours), name
