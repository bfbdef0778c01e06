"""The simulated cell: the world with its camera and devices, and the nodes of the cell."""

from launch import LaunchDescription
from tapping_cell.cli.cell_launch import LaunchedNode, cell_launch

ARGUMENTS = {
    "truth_file": ("", "simulation parameter file; if empty, the package's default"),
    "seed": ("1", "random seed of the world's noise and scatter"),
    "arm_port": ("", "path of the arm's simulated port; if empty, the one in the cell file"),
    "tapper_port": ("", "path of the tapper's simulated port; if empty, the one in the cell file"),
}
CELL = {"cell_file": "cell_file", "frame_prefix": "frame_prefix"}
FILES = {**CELL, "object_file": "object_file"}
WORLD = {name: name for name in ARGUMENTS}


def generate_launch_description() -> LaunchDescription:
    """Return the launch description.

    ``ros2 launch tapping_cell sim.launch.py --show-args`` describes every argument.
    """
    nodes = (
        LaunchedNode("sim_world", {**FILES, **WORLD}),
        LaunchedNode("camera_pose", FILES, respawn=True),
        LaunchedNode("tap_planner", {**FILES, "planner": "planner"}),
        LaunchedNode(
            "scara_arm",
            {**FILES, "arm_port": "port"},
            # A simulated arm cannot hurt anyone.
            parameters={"home_on_activate": True},
        ),
        LaunchedNode("tapper_trigger", {**CELL, "tapper_port": "port"}),
        LaunchedNode("run_recorder", {**FILES, "runs": "folder", "seed": "seed"}, respawn=True),
    )
    return cell_launch(ARGUMENTS, nodes)
