"""Imports between subpackages follow one direction, and each external library is imported only by
the subpackages that need it."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "tapping_cell"

# What each subpackage may import from this package: subpackages, or single modules of them. A
# subpackage may import itself.
ARROWS = {
    "se2": set(),
    "durable_file": set(),
    "messages": set(),
    "mechanics": {"se2"},
    "vision": {"se2"},
    "hardware": {"se2", "vision.images"},
    "planning": {"se2", "durable_file", "mechanics"},
    "configuration": {"se2", "mechanics", "vision", "hardware", "planning"},
    # The simulation uses the protocols of the devices and renders the camera's images.
    "simulation": {
        "se2",
        "mechanics",
        "hardware",
        "vision.camera",
        "vision.markers.detection",
        "vision.outline.shape",
        "configuration",
    },
    "calibration": {"se2", "durable_file", "mechanics", "vision", "hardware", "configuration"},
    "tapping_env": {"se2", "planning", "configuration", "simulation"},
    "report": {"se2", "durable_file", "mechanics", "planning", "configuration"},
    "logic": {"se2", "messages", "hardware", "planning", "vision", "configuration"},
    "conformance": {"se2", "messages", "logic", "configuration"},
    "nodes": {
        "se2",
        "durable_file",
        "messages",
        "logic",
        "conformance",
        "mechanics",
        "vision",
        "hardware",
        "planning",
        "configuration",
        "simulation",
        "calibration",
        "report",
    },
    "cli": {
        "se2",
        "durable_file",
        "messages",
        "logic",
        "conformance",
        "mechanics",
        "vision",
        "hardware",
        "planning",
        "configuration",
        "simulation",
        "calibration",
        "report",
        "nodes",
    },
    "__main__": {"cli"},
}
ROS_SUBPACKAGES = {"nodes", "cli"}
# External libraries that only the listed subpackages may import.
HOMES = {
    "serial": {"hardware"},
    "matplotlib": {"report"},
    "jinja2": {"report"},
    "distributed": {"cli"},
    "rich": {"cli", "report"},
    "rosbags": {"report"},
    "PIL": {"vision", "report"},
    "tornado": {"nodes"},
    "argcomplete": {"cli"},
    "gymnasium": {"tapping_env"},
    "prometheus_client": {"nodes"},
    "pyarrow": {"report"},
}
# These modules open real ports. The simulated world must never open a real port, so it may not
# import these modules.
DRIVERS = {"serial_transport", "arm", "tapper"}
# Other external libraries that may be imported by the subpackages that need them.
COMMON = {"numpy", "scipy", "cv2", "yaml", "ament_index_python"}


class Import(NamedTuple):
    """An import statement of a module in ``subpackage``."""

    subpackage: str
    file: str
    line: int
    name: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line} imports {self.name}"


def imports_of(package: Path) -> Iterator[Import]:
    """Return all imports in the package, at any place in a module."""
    for file in sorted(package.rglob("*.py")):
        place = file.relative_to(package)
        subpackage = place.parts[0].removesuffix(".py")
        parents = (package.name, *place.parts[:-1])
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                base = ".".join(parents[: len(parents) + 1 - node.level]) if node.level else ""
                module = ".".join(part for part in (base, node.module) if part)
                # ``from tapping_cell import se2`` imports a subpackage, not the package
                names = [
                    f"{module}.{alias.name}" if module == package.name else module
                    for alias in node.names
                ]
            else:
                continue
            for name in dict.fromkeys(names):
                yield Import(subpackage, str(place), node.lineno, name)


def is_ros(name: str) -> bool:
    """Return whether the module is ROS's client library or one of its message packages."""
    top = name.split(".")[0]
    return top in {"rclpy", "launch", "launch_ros", "tf2_ros"} or top.endswith(
        ("_msgs", "_srvs", "_interfaces")
    )


# These names are documented although they begin with an underscore.
PUBLIC_UNDERSCORES = {"_fields", "_replace", "_asdict", "_make", "_SubParsersAction"}


def is_private(name: str) -> bool:
    """Return whether a name is private by convention."""
    return name.startswith("_") and not name.endswith("__") and name not in PUBLIC_UNDERSCORES


def foreign_privates(package: Path) -> list[str]:
    """Return private members and modules of other packages that the code uses: names with an
    underscore that the package does not define itself."""
    own: set[str] = set()
    used: list[tuple[Path, ast.AST, str]] = []
    for file in sorted(package.rglob("*.py")):
        own |= {part.removesuffix(".py") for part in file.relative_to(package).parts}
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
                own.add(node.name)
            elif isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load):
                own.add(node.id)
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                # Attributes assigned to self or cls belong to this package.
                if isinstance(node.ctx, ast.Store) and node.value.id in ("self", "cls"):
                    own.add(node.attr)
                elif is_private(node.attr):
                    used.append((file, node, node.attr))
            elif isinstance(node, ast.Attribute) and is_private(node.attr):
                used.append((file, node, node.attr))
            elif isinstance(node, ast.Import):
                used += [(file, node, part) for a in node.names for part in a.name.split(".")]
            elif isinstance(node, ast.ImportFrom):
                names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
                used += [(file, node, part) for part in names]
    return [
        f"{file.relative_to(package)}:{node.lineno} uses {name}"
        for file, node, name in used
        if is_private(name) and name not in own
    ]


def against_the_arrows(imports: list[Import], package: str) -> list[Import]:
    """Return imports of this package that ARROWS does not allow."""
    wrong = []
    for found in imports:
        parts = found.name.split(".")
        if parts[0] != package or found.subpackage == "__init__":
            continue
        target = parts[1] if len(parts) > 1 else ""
        allowed = ARROWS.get(found.subpackage, set()) | {found.subpackage}
        if {".".join(parts[1:end]) for end in range(2, len(parts) + 1)} & allowed:
            continue
        if target not in ARROWS and target != "":
            continue  # a name defined in the package itself, such as __version__
        wrong.append(found)
    return wrong


def strangers(imports: list[Import], package: str) -> list[Import]:
    """Return imports of external libraries by subpackages that may not use them."""
    wrong = []
    for found in imports:
        top = found.name.split(".")[0]
        if top == package or top in sys.stdlib_module_names or top in COMMON:
            continue
        home = ROS_SUBPACKAGES if is_ros(found.name) else HOMES.get(top, set())
        if found.subpackage not in home:
            wrong.append(found)
    return wrong


def drivers_in_the_world(imports: list[Import], package: str) -> list[Import]:
    """Return imports of the drivers of real devices by the simulated world."""
    prefix = f"{package}.hardware."
    return [
        found
        for found in imports
        if found.subpackage == "simulation"
        and found.name.startswith(prefix)
        and found.name.removeprefix(prefix).split(".")[0] in DRIVERS
    ]


def cycles(edges: dict[str, set[str]]) -> list[str]:
    """Return the subpackages that import themselves through others."""
    found = []
    for start in edges:
        seen: set[str] = set()
        ahead = list(edges[start])
        while ahead:
            subpackage = ahead.pop()
            if subpackage not in seen:
                seen.add(subpackage)
                ahead.extend(edges.get(subpackage, ()))
        if start in seen:
            found.append(start)
    return found


@pytest.fixture(scope="module")
def real_imports() -> list[Import]:
    return list(imports_of(PACKAGE))


def test_every_subpackage_has_import_rules():
    subpackages = {
        path.name.removesuffix(".py")
        for path in PACKAGE.iterdir()
        if path.suffix == ".py" or any(path.glob("*.py"))
    }
    assert subpackages - {"__init__"} <= set(ARROWS)


def test_import_rules_have_no_cycle():
    edges = {subpackage: {name.split(".")[0] for name in to} for subpackage, to in ARROWS.items()}
    assert cycles(edges) == []


def test_subpackages_import_only_what_the_rules_allow(real_imports):
    assert len(real_imports) > 100  # the search has found the code
    assert [str(found) for found in against_the_arrows(real_imports, PACKAGE.name)] == []


def test_external_libraries_are_used_only_in_their_subpackages(real_imports):
    assert [str(found) for found in strangers(real_imports, PACKAGE.name)] == []


def test_the_simulation_drives_no_real_device(real_imports):
    assert [str(found) for found in drivers_in_the_world(real_imports, PACKAGE.name)] == []


def test_no_private_member_of_another_package_is_used():
    assert foreign_privates(PACKAGE) == []


@pytest.mark.parametrize(
    "code",
    [
        "from rclpy._rclpy_pybind11 import RCLError",
        "from rclpy import _rclpy_pybind11",
        "import rclpy._rclpy_pybind11 as implementation",
        "class Mine(Node):\n    def names(self):\n        return self._parameter_overrides",
        "def names(node):\n    return list(node._parameter_overrides)",
    ],
)
def test_a_planted_private_member_is_found(tmp_path, code):
    (tmp_path / "bad.py").write_text(code)
    assert len(foreign_privates(tmp_path)) == 1


def test_private_members_of_the_same_package_are_allowed(tmp_path):
    (tmp_path / "good.py").write_text("class A:\n    def f(self):\n        self._x = 1\n")
    (tmp_path / "also.py").write_text("def g(a):\n    return a._x, a.__class__, a._fields\n")
    assert foreign_privates(tmp_path) == []


def test_no_subpackage_is_named_utils():
    vague = {"utils", "util", "helpers", "misc", "common", "tools"}
    assert [file for file in PACKAGE.rglob("*") if file.stem in vague] == []


PLANTED = [
    ("mechanics/bad.py", "from tapping_cell.planning import make_planner", against_the_arrows),
    ("mechanics/bad.py", "from tapping_cell import vision", against_the_arrows),
    ("mechanics/bad.py", "from ..hardware import scara", against_the_arrows),
    ("mechanics/deep/bad.py", "from ...cli import main", against_the_arrows),
    ("se2.py", "from tapping_cell.mechanics import Tap", against_the_arrows),
    ("planning/bad.py", "def f():\n    import tapping_cell.hardware.scara", against_the_arrows),
    ("simulation/bad.py", "from tapping_cell.vision.tracker import T", against_the_arrows),
    ("simulation/bad.py", "from tapping_cell.vision.markers.edges import E", against_the_arrows),
    ("nodes/bad.py", "from tapping_cell.cli import main", against_the_arrows),
    ("hardware/bad.py", "import tapping_cell.simulation as world", against_the_arrows),
    ("mechanics/bad.py", "import rclpy", strangers),
    ("vision/bad.py", "from sensor_msgs.msg import Image", strangers),
    ("planning/bad.py", "from tapping_cell_msgs.msg import PlanState", strangers),
    ("configuration/bad.py", "from builtin_interfaces.msg import Time", strangers),
    ("planning/bad.py", "def f():\n    import matplotlib.pyplot as plt", strangers),
    ("nodes/bad.py", "import serial", strangers),
    ("simulation/bad.py", "from serial import Serial", strangers),
    ("hardware/bad.py", "from std_srvs.srv import Trigger", strangers),
    ("vision/bad.py", "import pandas", strangers),
    ("logic/bad.py", "from lab.trial import Trial", strangers),
    ("simulation/bad.py", "from tapping_cell.hardware.arm import ArmDriver", drivers_in_the_world),
]


@pytest.mark.parametrize(("file", "code", "check"), PLANTED)
def test_a_planted_violation_is_found(tmp_path, file, code, check):
    place = tmp_path / "tapping_cell" / file
    place.parent.mkdir(parents=True)
    place.write_text(code)
    assert [
        found.file for found in check(list(imports_of(tmp_path / "tapping_cell")), "tapping_cell")
    ] == [file]


@pytest.mark.parametrize(
    ("file", "code"),
    [
        ("mechanics/good.py", "import math\nimport numpy as np\nfrom tapping_cell import se2"),
        ("mechanics/good.py", "from . import bodies\nfrom .sliding import Sliding"),
        ("hardware/good.py", "import serial\nfrom tapping_cell.se2 import Pose"),
        ("nodes/good.py", "import rclpy\nfrom tapping_cell_msgs.msg import ArmState"),
        ("simulation/good.py", "from tapping_cell.vision.camera import CameraModel"),
        ("cli/good.py", "from tapping_cell import __version__"),
        ("report/good.py", "from matplotlib.figure import Figure"),
    ],
)
def test_allowed_imports_are_accepted(tmp_path, file, code):
    place = tmp_path / "tapping_cell" / file
    place.parent.mkdir(parents=True)
    place.write_text(code)
    found = list(imports_of(tmp_path / "tapping_cell"))
    assert found
    for check in (against_the_arrows, strangers, drivers_in_the_world):
        assert check(found, "tapping_cell") == []


def test_a_cycle_is_found():
    assert cycles({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]
