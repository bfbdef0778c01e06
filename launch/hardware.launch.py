"""The cell on hardware: camera, arm and tapper as the cell file describes them."""

from launch_ros.actions import Node

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration

ARGUMENTS = {
    "namespace": ("", "namespace of every node, one for each cell"),
    "cell_file": ("", "cell file of this cell; empty for the package's own"),
    "object_file": ("", "object file; empty for the cell file's"),
    "planner": ("", "planning method; empty for the cell file's"),
    "camera": ("/dev/video0", "device, video file or folder of images"),
    "exposure": ("0.0", "time of exposure in s; 0 leaves it to the device"),
}
# A node that moves nothing may come back by itself; arm and tapper come back by a person's hand.
RESPAWNED = {"overhead_camera", "camera_pose"}


def generate_launch_description() -> LaunchDescription:
    """Every argument is described: ``ros2 launch tapping_cell hardware.launch.py --show-args``."""
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    cell = {"cell_file": given["cell_file"]}
    files = {**cell, "object_file": given["object_file"]}
    parameters = {
        "overhead_camera": {**cell, "source": given["camera"], "exposure": given["exposure"]},
        "camera_pose": files,
        "tap_planner": {**files, "planner": given["planner"]},
        "scara_arm": cell,
        "tapper_trigger": cell,
    }
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            *(
                Node(
                    package="tapping_cell",
                    executable=name,
                    name=name,
                    namespace=given["namespace"],
                    parameters=[values],
                    output="screen",
                    respawn=name in RESPAWNED,
                    respawn_delay=1.0,
                )
                for name, values in parameters.items()
            ),
        ]
    )
