"""Images use shared memory. Nodes that may be killed and restarted during a tap use UDP only."""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tapping_cell.cli.graph import IMAGES
from tapping_cell.nodes.camera.camera_pose import CameraPose
from tapping_cell.nodes.camera.overhead_camera import OverheadCamera
from tapping_cell.nodes.cell_node import PROFILE_VARIABLE, choose_transport
from tapping_cell.nodes.drivers.scara_arm import ScaraArm
from tapping_cell.nodes.drivers.tapper_trigger import TapperTrigger
from tapping_cell.nodes.page.operator_page import OperatorPage
from tapping_cell.nodes.planner.tap_planner import TapPlanner
from tapping_cell.nodes.recorder.run_recorder import RunRecorder
from tapping_cell.nodes.simulation.sim_world import SimWorld


def transports(path: str) -> set[str]:
    names = "{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}type"
    return {entry.text or "" for entry in ElementTree.parse(path).iter(names)}


@pytest.mark.parametrize(
    ("node", "expected"),
    [
        (TapPlanner, {"UDPv4"}),
        (ScaraArm, {"UDPv4"}),
        (TapperTrigger, {"UDPv4"}),
        (CameraPose, {"SHM", "UDPv4"}),
        (OverheadCamera, {"SHM", "UDPv4"}),
        (SimWorld, {"SHM", "UDPv4"}),
        (OperatorPage, {"SHM", "UDPv4"}),
        (RunRecorder, {"SHM", "UDPv4"}),
    ],
)
@pytest.mark.parametrize("before", ["", "/elsewhere/config/fastdds_profile.xml"])
def test_each_node_uses_the_transport_profile_for_its_messages(
    monkeypatch: pytest.MonkeyPatch, node: type, expected: set[str], before: str
) -> None:
    monkeypatch.setenv(PROFILE_VARIABLE, before)
    choose_transport(node.carries_pictures)  # type: ignore[attr-defined]
    assert transports(os.environ[PROFILE_VARIABLE]) == expected
    name = node.__module__.rpartition(".")[2]
    assert (name in IMAGES) == ("SHM" in expected)


def test_a_user_defined_profile_is_not_changed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    own = str(tmp_path / "my_profile.xml")
    monkeypatch.setenv(PROFILE_VARIABLE, own)
    choose_transport(False)
    assert os.environ[PROFILE_VARIABLE] == own
