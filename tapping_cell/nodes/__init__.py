"""ROS 2 nodes: each has parameters, topics and a state machine, but contains no mathematics."""

MODULES = {
    "overhead_camera": "tapping_cell.nodes.camera.overhead_camera",
    "camera_pose": "tapping_cell.nodes.camera.camera_pose",
    "tap_planner": "tapping_cell.nodes.planner.tap_planner",
    "scara_arm": "tapping_cell.nodes.drivers.scara_arm",
    "tapper_trigger": "tapping_cell.nodes.drivers.tapper_trigger",
    "sim_world": "tapping_cell.nodes.simulation.sim_world",
    "run_recorder": "tapping_cell.nodes.recorder.run_recorder",
    "operator_page": "tapping_cell.nodes.page.operator_page",
}
"""Module of each node. setup.py generates the executables of ``ros2 run`` from this table."""
