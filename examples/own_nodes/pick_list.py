"""A pick list: bring the object to one pose after the other, through the action of the planner.

python pick_list.py 0.02 0.01 30   -0.03 0.02 0      (x and y in m, angle in degrees)
"""

import math
import sys

import rclpy
from rclpy.action import ActionClient
from rclpy.node import Node
from tapping_cell_msgs.action import PositionObject

from tapping_cell.nodes.conversions import position_goal
from tapping_cell.se2 import Pose


def bring(node: Node, client: ActionClient, pose: Pose) -> PositionObject.Result:
    """Send a goal, print its progress, and return its result."""

    taps = -1

    def show(message: PositionObject.Impl.FeedbackMessage) -> None:
        nonlocal taps
        if message.feedback.taps > taps:
            taps = message.feedback.taps
            print(f"  after {taps} taps {1e3 * message.feedback.residual_distance:.1f} mm to go")

    goal = position_goal(pose, (0.0, 0.0), node.get_clock().now().to_msg())
    sent = client.send_goal_async(goal, feedback_callback=show)
    rclpy.spin_until_future_complete(node, sent)
    result = sent.result().get_result_async()
    rclpy.spin_until_future_complete(node, result)
    return result.result().result


def main(numbers: list[float]) -> int:
    """Bring the object to each pose; stop at the first that is not reached."""
    rclpy.init()
    node = Node("pick_list")
    client = ActionClient(node, PositionObject, "position_object")
    client.wait_for_server()
    for x, y, degrees in zip(numbers[::3], numbers[1::3], numbers[2::3], strict=True):
        print(f"goal: x {x} m, y {y} m, {degrees} deg")
        result = bring(node, client, Pose(x, y, math.radians(degrees)))
        if result.error_code:
            print(f"error {result.error_code}: {result.error_msg}", file=sys.stderr)
            return 1
        print(f"  reached after {result.taps} taps")
    return 0


if __name__ == "__main__":
    sys.exit(main([float(text) for text in sys.argv[1:]]))
