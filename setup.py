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


class EggInfo(egg_info):  # type: ignore[misc]
    """The step that every way to build begins with: it sees that the messages were built first."""

    def run(self) -> None:
        """Refuse to build a package that could not run."""
        prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
        if not any(Path(prefix, "share", f"{NAME}_msgs").is_dir() for prefix in prefixes if prefix):
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


setup(
    name=NAME,
    version="0.1.0",
    description="A robot cell that positions flat objects on a table by tapping them",
    license="Apache-2.0",
    maintainer="Tapping cell maintainers",
    maintainer_email="maintainers@tapping-cell.invalid",
    python_requires=">=3.10",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={
        NAME: [
            "py.typed",
            "**/*.yaml",
            "**/*.json",
            "nodes/page/static/*",
            "report/templates/*",
        ]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        *data_files("config", "launch"),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    cmdclass={"egg_info": EggInfo},
    entry_points={
        "console_scripts": [
            *(f"{node} = {module}:main" for node, module in NODES.items()),
            f"cell = {NAME}.cli:main",
        ]
    },
)
