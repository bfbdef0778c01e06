"""The package ``tapping_cell``: the program, its nodes and every file that they read."""

import os
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.egg_info import egg_info

NAME = "tapping_cell"
SHARE = f"share/{NAME}"
NODES = runpy.run_path(f"{NAME}/nodes/__init__.py")["MODULES"]
PIP = "setuptools.build_meta" in sys.modules
"""Whether pip builds the library without ROS. colcon calls this file without a build backend."""


class EggInfo(egg_info):  # type: ignore[misc]
    """The step that every way to build begins with: it sees that the messages were built first."""

    def run(self) -> None:
        """Refuse to build nodes that could not run."""
        prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
        built = any(Path(prefix, "share", f"{NAME}_msgs").is_dir() for prefix in prefixes if prefix)
        if not built and not PIP:
            here = Path(__file__).resolve().parent
            sys.exit(
                f"{NAME}_msgs is not built, and colcon does not look for it inside this package by "
                f"itself. Name both folders:\n\n"
                f"    colcon build --base-paths {here} {here}/msg_defs\n"
            )
        super().run()


def data_files(*folders: str) -> Iterator[tuple[str, list[str]]]:
    """Every file below the folders, each to its place in the package's share folder."""
    for folder in folders:
        places: dict[Path, list[str]] = {}
        for file in sorted(Path(folder).rglob("*")):
            if file.is_file() and "__pycache__" not in file.parts:
                places.setdefault(file.parent, []).append(str(file))
        for place, files in places.items():
            yield f"{SHARE}/{place}", files


SHARE_FILES = [
    ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
    (SHARE, ["package.xml"]),
    *data_files("config", "launch"),
]
COPIED = {} if not PIP else {f"{NAME}.{folder}": folder for folder in ("config", "msg_defs")}
"""Folders that pip copies into the package, because it has no share folder."""
LIBRARIES = [  # without ROS; package.xml lists those of the cell
    "argcomplete>=3",
    "jinja2>=3.0",
    "matplotlib>=3.6",
    "numpy>=1.26",
    "opencv-python-headless>=4.6,<5",  # 5 has no undistortPointsIter
    "pillow",
    "PyYAML>=6",
    "rich>=13.7",
    "rosbags>=0.11",
    "scipy>=1.11",
]

setup(
    name=NAME,
    version="0.1.0",
    description="A robot cell that positions flat objects on a table by tapping them",
    license="Apache-2.0",
    maintainer="Tapping cell maintainers",
    maintainer_email="maintainers@tapping-cell.invalid",
    python_requires=">=3.10",
    packages=[*find_packages(include=[NAME, f"{NAME}.*"]), *COPIED],
    package_dir=COPIED,
    package_data={
        NAME: [
            "py.typed",
            "**/*.yaml",
            "**/*.json",
            "nodes/page/static/*",
            "report/templates/*",
        ],
        **{package: ["**/*.*"] for package in COPIED},
    },
    data_files=[] if PIP else SHARE_FILES,
    install_requires=LIBRARIES if PIP else ["setuptools"],
    extras_require={
        "prometheus": ["prometheus_client"],
        "gym": ["gymnasium>=1.0"],
        "parquet": ["pandas", "pyarrow"],
        "test": ["pytest"],  # without it, colcon runs no test and reports success
    },
    zip_safe=False,
    cmdclass={"egg_info": EggInfo},
    entry_points={
        "console_scripts": [
            *(f"{node} = {module}:main" for node, module in NODES.items() if not PIP),
            f"cell = {NAME}.cli:main",
        ]
    },
)
