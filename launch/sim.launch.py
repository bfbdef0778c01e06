"""The simulated cell: the world with its camera and devices, and the four nodes of the cell."""

from launch_ros.actions import Node

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration

ARGUMENTS = {
    "namespace": ("", "namespace of every node, one for each cell"),
    "cell_file": ("", "cell file; empty for the package's own"),
    "object_file": ("", "object file; empty for the cell file's"),
    "truth_file": ("", "truth file of the world; empty for the package's own"),
    "planner": ("", "planning method; empty for the cell file's"),
    "seed": ("1", "of the world's noise and scatter"),
    "arm_port": ("", "where the arm's port appears; empty for the cell file's"),
    "tapper_port": ("", "where the tapper's port appears; empty for the cell file's"),
}


def generate_launch_description() -> LaunchDescription:
    """Every argument is described: ``ros2 launch tapping_cell sim.launch.py --show-args``."""
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    cell = {"cell_file": given["cell_file"]}
    files = {**cell, "object_file": given["object_file"]}
    world = {
        **files,
        "truth_file": given["truth_file"],
        "seed": given["seed"],
        "arm_port": given["arm_port"],
        "tapper_port": given["tapper_port"],
    }
    parameters = {
        "sim_world": world,
        "camera_pose": files,
        "tap_planner": {**files, "planner": given["planner"]},
        "scara_arm": {**cell, "port": given["arm_port"]},
        "tapper_trigger": {**cell, "port": given["tapper_port"]},
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
                )
                for name, values in parameters.items()
            ),
        ]
    )
