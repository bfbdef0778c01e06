"""Common parts of both files in the folder ``launch``: arguments, nodes and the arm's description.

Only ``ros2 launch`` imports this module. Without ROS's launch, use ``python -m tapping_cell up``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from tapping_cell.cli.graph import IMAGES_DELAY_S
from tapping_cell.cli.supervision import MAX_RESTARTS
from tapping_cell.configuration.cell import (
    Cell,
    load_cell,
    refuse_own_drivers,
    refuse_simulated_ports,
)
from tapping_cell.hardware.fixed_urdf import mounted_tappers_urdf
from tapping_cell.hardware.urdf import urdf
from tapping_cell.nodes import security

COMMON = {
    "namespace": ("", "namespace of every node, one for each cell"),
    "cell_file": ("", "cell file; if empty, the package's default"),
    "object_file": ("", "object file; if empty, the one named in the cell file"),
    "frame_prefix": (
        "",
        "prefix of the names of all frames, such as left/; the cell then uses the global /tf",
    ),
    "planner": ("", "planning method; if empty, the one named in the cell file"),
    "params_file": (
        "",
        "file of ROS parameters for every node; overrides parameters that other arguments set",
    ),
    "runs": ("runs", "folder in which every goal gets a run folder"),
    "use_sim_time": ("false", "use the time of /clock, for example while a bag is played"),
    "page": ("false", "serve the operator's web page"),
    "page_address": (
        "localhost",
        "address of the page; 0.0.0.0 for the whole network, with a token",
    ),
    "page_port": ("8010", "port of the page"),
    "page_stop_port": ("9010", "port of a second connection of the page, used only for STOP"),
    "description": ("true", "start robot_state_publisher with the URDF, if it is installed"),
}
"""Arguments of every launch file: default and description."""


@dataclass(frozen=True, slots=True)
class LaunchedNode:
    """One node of the graph, with the launch arguments that set its parameters."""

    name: str
    arguments: Mapping[str, str] = field(default_factory=dict)
    """Mapping from the name of a launch argument to the name of the node parameter that it sets."""
    respawn: bool = False
    parameters: Mapping[str, object] = field(default_factory=dict)
    """Values of node parameters that no launch argument sets, by name of the parameter."""


PAGE = LaunchedNode(
    "operator_page",
    {
        "cell_file": "cell_file",
        "object_file": "object_file",
        "page_address": "address",
        "page_port": "port",
        "page_stop_port": "stop_port",
        "runs": "runs",
    },
    respawn=True,
)
"""The operator's page, if requested. The page starts no motion unless an operator requests it."""


def cell_launch(
    arguments: Mapping[str, tuple[str, str]],
    nodes: Sequence[LaunchedNode],
    hardware: bool = False,
) -> LaunchDescription:
    """Return a launch description of the nodes, with their own and the common arguments.

    ``hardware``: the nodes drive real devices, so a cell file with simulated ports is refused.
    """
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in {**COMMON, **arguments}.items()
            ),
            OpaqueFunction(function=lambda context: _start(context, nodes, hardware)),
        ]
    )


def _start(
    context: LaunchContext, nodes: Sequence[LaunchedNode], hardware: bool
) -> list[Node | LogInfo]:
    """Return the nodes to start. The launch system calls this function when the values of the
    launch arguments are known."""
    given = context.launch_configurations
    refuse = refuse_simulated_ports if hardware else refuse_own_drivers
    cell = load_cell(given["cell_file"] or None)
    refuse(cell)
    if cell.file.arm is None:
        nodes = [node for node in nodes if node.name != "scara_arm"]
    shared: list[dict[str, object] | str] = [{"use_sim_time": LaunchConfiguration("use_sim_time")}]
    overrides = [given["params_file"]] if given["params_file"] else []
    if given["page"].lower() == "true":
        nodes = (*nodes, PAGE)
    description = given["description"].lower() == "true"
    # The arm's node publishes the frames of its links only if no robot_state_publisher does: a
    # frame may have only one publisher.
    links = {"link_frames": not (description and _has_state_publisher())}
    started: list[Node | LogInfo] = [
        Node(
            package="tapping_cell",
            executable=node.name,
            name=node.name,
            namespace=given["namespace"],
            parameters=[
                *shared,
                {**node.parameters, **(links if node.name == "scara_arm" else {})},
                # An empty argument sets no parameter. The node's default then applies, unless
                # params_file sets the parameter.
                {
                    name: LaunchConfiguration(key)
                    for key, name in node.arguments.items()
                    if given[key]
                },
                *overrides,
            ],
            ros_arguments=(
                ["--enclave", security.enclave_of(node.name)] if security.is_enabled() else []
            ),
            remappings=_own_frames(given),
            output="screen",
            respawn=node.respawn,
            respawn_delay=IMAGES_DELAY_S,
            # The number of restarts is limited, because a node with an invalid configuration ends
            # again after each restart.
            respawn_max_retries=MAX_RESTARTS,
        )
        for node in nodes
    ]
    if description:
        started += _describe(given, cell, shared)
    return started


def _describe(
    given: Mapping[str, str], cell: Cell, shared: list[dict[str, object] | str]
) -> list[Node | LogInfo]:
    """Return the node robot_state_publisher, or a log message with the reason why it is not
    started.

    For RViz and Foxglove, the node publishes the URDF of the arm or of the fixed tappers. It also
    publishes the arm's links on /tf, computed from the joint states.
    """
    if not _has_state_publisher():
        return [
            LogInfo(
                msg="robot_description is not published, because robot_state_publisher is not "
                "installed"
            )
        ]
    if cell.file.arm is not None and cell.arm.chain() is not None:
        return [LogInfo(msg="the arm has its own URDF, which the arm's own driver publishes")]
    text = (
        mounted_tappers_urdf(cell.mounted_tappers())
        if cell.file.arm is None
        else urdf(cell.arm.geometry())
    )
    return [
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            namespace=given["namespace"],
            parameters=[
                *shared,
                {"robot_description": text, "frame_prefix": given["frame_prefix"]},
            ],
            remappings=_own_frames(given),
        )
    ]


def _has_state_publisher() -> bool:
    try:
        get_package_prefix("robot_state_publisher")
    except PackageNotFoundError:
        return False
    return True


def _own_frames(given: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return remappings of /tf and /tf_static into the namespace. Without a prefix, all cells use
    the same frame names."""
    shared = not given["namespace"] or given["frame_prefix"]
    return [] if shared else [("/tf", "tf"), ("/tf_static", "tf_static")]
