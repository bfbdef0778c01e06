"""Clients find nodes with another name (``__node:=``), and such nodes keep their stop."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from harness import bench
from tapping_cell_msgs.msg import StopState
from test_camera_pose import Cell as CameraCell

from tapping_cell.configuration.cell import load_cell
from tapping_cell.nodes.camera.camera_pose import CameraPose
from tapping_cell.nodes.cell_identity import key_of, state_folder
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.clients.cell_client import CellClient
from tapping_cell.nodes.drivers.scara_arm import ScaraArm
from tapping_cell.simulation.scene import make_renderer
from tapping_cell.simulation.truth import CameraTruth

NAMES = ("scara_arm:__node:=robot", "camera_pose:__node:=eye")


@pytest.fixture
def client(own_graph: None) -> Iterator[CellClient]:
    with CellClient() as made:
        yield made


def rows(client: CellClient) -> dict[str, dict[str, str]]:
    return {row["role"]: row for row in client.state()["nodes"]}


def test_a_renamed_arm_is_listed_stopped_and_keeps_its_stop(
    tmp_path: Path, client: CellClient
) -> None:
    arms: list[ScaraArm] = []

    def make() -> list[object]:
        arms.append(ScaraArm())
        return [*arms, CameraPose()]

    port = {"port": tmp_path / "nowhere"}
    with bench(make, {"robot": port, "eye": {}}, NAMES) as b:
        stops = b.listen(StopState, "robot/stop_state", LATCHED)
        b.wait(lambda: rows(client)["scara_arm"]["name"] == "robot", "the arm is listed")
        b.wait(lambda: rows(client)["camera_pose"]["life"] == "active", "the camera is listed")
        names = [row["name"] for row in client.state()["nodes"]]
        assert "scara_arm" not in names and len(names) == len(set(names))
        b.wait(
            lambda: client._private.client("scara_arm", "stop").srv_name == "/robot/stop", "STOP"
        )
        answered = client._call("scara_arm", "stop")
        assert answered[0], answered
        b.wait(lambda: stops and stops[-1].stopped, "the arm is stopped")
        b.wait(lambda: "scara_arm" in client._view.stops, "the client knows the stop")
        assert not b.probe.count_services("scara_arm/stop")
        # The file is named after the executable, not after the node.
        kept = state_folder(key_of(arms[0])) / "stop-scara_arm.json"
        b.wait(kept.exists, "the stop is stored")


def test_no_camera_is_missing_with_images_of_any_camera_driver(client: CellClient) -> None:
    configuration = load_cell()
    renderer = make_renderer(configuration, CameraTruth(), configuration.outline(), 1)
    with bench(lambda: [CameraPose()], {}) as b:
        b.wait(lambda: rows(client)["camera_pose"]["life"] == "active", "the node is active")
        assert rows(client)["overhead_camera"]["life"] == "not running"
        film = CameraCell(b, b.listen_own_object(), [], renderer)

        def has_no_camera_row() -> bool:
            film.show(5)
            return "overhead_camera" not in rows(client)

        b.wait(has_no_camera_row, "the camera driver is recognised")
