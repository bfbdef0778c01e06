"""The cell on hardware: camera, arm and tapper as the cell file describes them."""

from launch import LaunchDescription
from tapping_cell.cli.cell_launch import LaunchedNode, cell_launch

ARGUMENTS = {
    "camera": ("/dev/video0", "device, video file or folder of images"),
    "exposure": ("0.0", "exposure time in s; 0 leaves it to the device"),
}
CELL = {"cell_file": "cell_file", "frame_prefix": "frame_prefix"}
FILES = {**CELL, "object_file": "object_file"}


def generate_launch_description() -> LaunchDescription:
    """Return the launch description.

    ``ros2 launch tapping_cell hardware.launch.py --show-args`` describes every argument.
    """
    # Only nodes that move nothing are restarted automatically. A person restarts the others.
    nodes = (
        LaunchedNode(
            "overhead_camera", {**CELL, "camera": "source", "exposure": "exposure"}, respawn=True
        ),
        LaunchedNode("camera_pose", FILES, respawn=True),
        LaunchedNode("tap_planner", {**FILES, "planner": "planner"}),
        LaunchedNode("scara_arm", FILES),
        LaunchedNode("tapper_trigger", CELL),
        LaunchedNode("run_recorder", {**FILES, "runs": "folder"}, respawn=True),
    )
    return cell_launch(ARGUMENTS, nodes, hardware=True)
