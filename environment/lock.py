"""Write ``requirements.lock``: exact versions and hashes for every supported version of Python.

    python3 environment/lock.py

uv resolves ``requirements.in`` for every Python from 3.10 on in one run, and keeps the versions of
the existing lock if these versions still satisfy the requirements. ``UV_DEFAULT_INDEX`` selects
another package index.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
LOCK = HERE.parent / "requirements.lock"
UV = "uv==0.13.9"
HEADER = """\
# Exact versions and hashes of everything in .venv, made by `make lock` from
# environment/requirements.in. It is complete: nothing else is installed for what packages need.
"""
# Packages that others name as needed, but that neither the build, the tests nor the cell import.
UNUSED = (
    # linters of ament, which a build without its tests does not call
    *(
        f"ros-ament-cmake-{name}"
        for name in ("cppcheck", "cpplint", "flake8", "pep257", "uncrustify")
    ),
    # options of `colcon test`, and the search for pkg-config files
    "colcon-pkg-config",
    "coverage",
    "pytest-cov",
    "pytest-repeat",
    "pytest-rerunfailures",
    "docutils",  # catkin-pkg parses changelogs with it
)


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        python = f"{folder}/bin/python"
        subprocess.run([python, "-m", "pip", "install", "--quiet", UV], check=True)
        made = Path(folder, "requirements.lock")
        made.write_text(LOCK.read_text())
        compile_all = [python, "-m", "uv", "pip", "compile", "--quiet", "--universal"]
        compile_all += ["--python-version", "3.10"]
        compile_all += ["--generate-hashes", "--no-annotate", "--no-header", "--system-certs"]
        compile_all += ["--no-python-downloads", "--output-file", str(made)]
        compile_all += [f"--no-emit-package={name}" for name in UNUSED]
        subprocess.run([*compile_all, str(HERE / "requirements.in")], check=True)
        LOCK.write_text(HEADER + made.read_text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
