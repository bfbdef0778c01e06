"""Run Python as in an environment without ROS and without the libraries of the devices."""

import os
import subprocess
import sys
from pathlib import Path

BLOCK = """
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        top = name.split(".")[0]
        if top in {"rclpy", "launch", "serial", "tornado"} or top.startswith("ament_") or (
            top.endswith(("_msgs", "_srvs", "_interfaces"))
        ):
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)

sys.meta_path.insert(0, Blocked())
"""
"""Start-up file that hides ROS and every library that the wheel does not require."""


def run(package: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder, with the package in ``package``."""
    (folder / "sitecustomize.py").write_text(BLOCK, encoding="utf-8")
    environment = {
        **os.environ,
        "PYTHONPATH": f"{folder}{os.pathsep}{package}",
        "AMENT_PREFIX_PATH": "",
        "XDG_CACHE_HOME": str(folder / "cache"),
    }
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True
    )
