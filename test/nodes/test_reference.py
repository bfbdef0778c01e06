"""docs/nodes.md lists each parameter, topic, service and error code, and no others."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
from pathlib import Path

import reference_pages
from harness import bench
from tapping_cell_msgs.msg import ErrorCode

from tapping_cell.nodes import MODULES
from tapping_cell.nodes.camera.overhead_camera import OverheadCamera
from tapping_cell.nodes.drivers.scara_arm import ScaraArm
from tapping_cell.nodes.drivers.tapper_trigger import TapperTrigger
from tapping_cell.nodes.planner.tap_planner import TapPlanner
from tapping_cell.nodes.recorder.run_recorder import RunRecorder
from tapping_cell.nodes.simulation.sim_world import SimWorld
from tapping_cell.report import error_codes

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = (DOCS / "nodes.md").read_text(encoding="utf-8")
NODES = (
    "overhead_camera",
    "camera_pose",
    "tap_planner",
    "scara_arm",
    "tapper_trigger",
    "sim_world",
    "operator_page",
    "run_recorder",
)


def section(title: str) -> str:
    """Return the text under a heading, up to the next heading."""
    found = re.search(rf"^#+ {re.escape(title)}$(.*?)(?=^#|\Z)", PAGE, re.MULTILINE | re.DOTALL)
    assert found, f"docs/nodes.md has no heading '{title}'"
    return found[1]


def test_every_parameter_is_listed_with_its_description_and_range() -> None:
    """If this fails, run: make reference"""
    assert reference_pages.nodes_page() == PAGE
    named = set(re.findall(r"^- `(\w+)` \(", PAGE, re.MULTILINE))
    assert named == {
        entry.name
        for module in MODULES.values()
        for entry in dataclasses.fields(importlib.import_module(module).Parameters)
    }


def test_the_built_messages_have_the_declared_error_codes() -> None:
    names = [name for name in dir(ErrorCode) if isinstance(getattr(ErrorCode, name), int)]
    built = {name: getattr(ErrorCode, name) for name in names if name.isupper()}
    assert built == {code.name: number for number, code in error_codes.codes().items()}


def test_every_topic_and_service_of_the_nodes_is_listed() -> None:
    from tapping_cell.nodes.camera.camera_pose import CameraPose
    from tapping_cell.nodes.page.operator_page import OperatorPage

    cell = (OverheadCamera, CameraPose, TapPlanner, ScaraArm, TapperTrigger, SimWorld)
    kinds = (*cell, OperatorPage, RunRecorder)
    still = {name: {"autostart": False} for name in NODES}
    with bench(lambda: [kind() for kind in kinds], still) as b:
        node = b.probe
        assert node is not None
        b.wait(lambda: set(NODES) <= set(node.get_node_names()), "every node is seen")
        topics = {name for name, _ in node.get_topic_names_and_types()}
        services = {name for name, _ in node.get_service_names_and_types()}
    documented = set(re.findall(r"^\| `/?([\w/]+)` \|", section("Topics"), re.MULTILINE))
    ours = {name.lstrip("/") for name in topics if not re.search(r"/_|rosout|_event", name)}
    ours -= {"probe", "parameter_events"}
    if importlib.util.find_spec("vision_msgs") is None:
        documented.remove("detections")
    actions = {"arrange_objects", "position_object", "single_tap"}
    assert ours == documented - actions - {"confirm_tap", "hold_still", "reset_world"}
    ends = re.compile(r"/(cancel|home|jog|stop|clear_\w+|press_\w+)$")
    private = {name for name in services if ends.search(name)}
    for name in private:
        assert f"`~/{name.rsplit('/', 1)[1]}`" in PAGE, name
    assert "/reset_world" in services and "`reset_world`" in PAGE
