"""One parameter file configures all nodes of a cell, in any namespace; an unknown name is
refused."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.lifecycle import LifecycleNode

from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.nodes import MODULES

CLASSES = {
    "camera_pose": "CameraPose",
    "overhead_camera": "OverheadCamera",
    "run_recorder": "RunRecorder",
    "scara_arm": "ScaraArm",
    "sim_world": "SimWorld",
    "tap_planner": "TapPlanner",
    "tapper_trigger": "TapperTrigger",
}
EXAMPLE = shared_folder() / "parameters.yaml"


@contextmanager
def started(node: str, file: Path, namespace: str = "/") -> Iterator[Any]:
    """Create a node with a parameter file, without spinning it."""
    rclpy.init(args=["--ros-args", "-r", f"__ns:={namespace}", "--params-file", str(file)])
    made = None
    try:
        module = importlib.import_module(MODULES[node])
        made = getattr(module, CLASSES[node])()
        yield made
    finally:
        if made is not None:
            made.cleanup()
            made.destroy_node()
        rclpy.try_shutdown()


@pytest.mark.parametrize("namespace", ["/", "/left", "/hall/left"])
@pytest.mark.parametrize("node", CLASSES)
def test_the_example_file_is_valid_for_every_node(node: str, namespace: str) -> None:
    with started(node, EXAMPLE, namespace) as made:
        assert made.settings.autostart is True
        if node == "run_recorder":
            assert made.settings.least_free == 500.0


FILE = """
/**/tap_planner:
  ros__parameters: {attempts: 7}
/left/tap_planner:
  ros__parameters: {place_deadline: 11.0}
"""


def test_a_value_reaches_its_node_and_no_other(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(FILE)
    with started("tap_planner", file, "/left") as made:
        assert (made.settings.attempts, made.settings.place_deadline) == (7, 11.0)
    with started("tap_planner", file, "/right") as made:
        assert (made.settings.attempts, made.settings.place_deadline) == (7, 20.0)
    with started("scara_arm", file, "/left") as made:
        assert made.settings.state_rate == 20.0


@pytest.mark.parametrize("name", ["/**", "/**/{node}", "/left/{node}"])
@pytest.mark.parametrize("node", CLASSES)
def test_an_unknown_name_is_refused_by_every_node(
    node: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(f"{name.format(node=node)}:\n  ros__parameters: {{atempts: 3}}\n")
    module = importlib.import_module(MODULES[node])
    destroyed = []
    destroy = LifecycleNode.destroy_node
    monkeypatch.setattr(LifecycleNode, "destroy_node", lambda n: (destroyed.append(n), destroy(n)))
    refused = pytest.raises(ConfigurationError, match="unknown parameter 'atempts'")
    with refused, started(node, file, "/left"):
        pass
    # A node that is left to the garbage collector can block the process for ever.
    assert [type(one) for one in destroyed] == [getattr(module, CLASSES[node])]
