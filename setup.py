"""The package ``tapping_cell``: the program, its nodes and every file that they read."""

import runpy
from collections.abc import Iterator
from pathlib import Path

from setuptools import find_packages, setup

NAME = "tapping_cell"
SHARE = f"share/{NAME}"
NODES = runpy.run_path(f"{NAME}/nodes/__init__.py")["MODULES"]


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
    package_data={NAME: ["py.typed", "**/*.yaml", "**/*.json", "nodes/page/static/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        *data_files("config", "launch"),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            *(f"{node} = {module}:main" for node, module in NODES.items()),
            f"cell = {NAME}.cli:main",
        ]
    },
)
