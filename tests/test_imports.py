"""The floors of the house: which room may import which, what `import jaxtri` loads, and how long a file may be."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import jaxtri

PACKAGE = Path(jaxtri.__file__).parent

# From the ground up; an import points to a lower floor, or stays in its room. CONTRIBUTING.md shows the same.
FLOORS = (
    ("errors",),
    ("checks", "compilation"),
    ("filters", "geometry", "trajectory"),
    ("estimation", "formats"),
    ("models", "synthetic", "vision"),
    ("odometry",),
    ("output",),
    ("cli",),
)
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
CV2 = ("vision/", "output/overlay.py", "synthetic/rendered.py")


def imports(path: Path) -> set[str]:
    """Modules that a file names in an import, at the top or within a function; a name imported from one is its own."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


FILES = sorted(p.relative_to(PACKAGE).as_posix() for p in PACKAGE.rglob("*.py"))


def test_every_room_has_its_floor():
    rooms = {p.name if p.is_dir() else p.stem for p in PACKAGE.iterdir() if p.is_dir() or p.suffix == ".py"}
    assert rooms - {"__init__", "__pycache__"} == set(FLOOR)
    assert sum(p.suffix == ".py" for p in PACKAGE.iterdir()) <= 6


@pytest.mark.parametrize("name", [f for f in FILES if f != "__init__.py"])
def test_imports_point_down(name):
    room = Path(name).parts[0].removesuffix(".py")
    for module in imports(PACKAGE / name):
        if module.split(".")[0] == "cv2":
            assert name.startswith(CV2), f"{name} imports OpenCV"
        if module.startswith("jaxtri."):
            other = module.split(".")[1]
            assert other == room or FLOOR[other] < FLOOR[room], f"{name} imports {module}"
        else:
            assert module != "jaxtri", f"{name} imports the public face"


@pytest.mark.parametrize("name", FILES)
def test_files_are_short(name):
    assert len((PACKAGE / name).read_text().splitlines()) <= 400


def test_the_core_loads_without_opencv_or_matplotlib():
    core = ("jaxtri", "jaxtri.filters.ekf", "jaxtri.models.trifocal", "jaxtri.formats", "jaxtri.synthetic")
    code = (
        f"import sys, {', '.join(core)}\n"
        "print(sorted({'cv2', 'matplotlib', 'tqdm', 'tyro', 'scipy.spatial', 'yaml'} & set(sys.modules)))\n"
        "import jax; print(jax.config.jax_enable_x64)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", "False"], done.stdout + done.stderr


def test_every_public_name_can_be_had():
    assert set(jaxtri.__all__) <= set(dir(jaxtri))
    assert all(getattr(jaxtri, name) is not None for name in jaxtri.__all__)
    with pytest.raises(AttributeError, match="no_such_name"):
        jaxtri.no_such_name  # noqa: B018
