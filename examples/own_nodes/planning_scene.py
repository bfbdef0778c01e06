"""The table and the objects of the cell as collision objects of MoveIt's planning scene.

It converts ``object_states`` to ``planning_scene``, for motions that MoveIt plans for the arm while
the cell is idle. Each object is a cylinder of its height around its outline. The frame ``table``
must be connected to the arm's frames in /tf.

    python planning_scene.py my_cell/cell.yaml
"""

import sys
from pathlib import Path

import rclpy
from geometry_msgs.msg import Pose
from moveit_msgs.msg import CollisionObject, PlanningScene
from rclpy.node import Node
from shape_msgs.msg import SolidPrimitive
from tapping_cell_msgs.msg import ObjectStates

from tapping_cell.configuration.cell import Cell, load_cell, load_further_objects
from tapping_cell.nodes.cell_node import LATCHED

THICKNESS = 0.02  # of the table, m


class ScenePublisher(Node):
    """Publishes the differences of the planning scene, once a second."""

    def __init__(self, cell: Cell) -> None:
        super().__init__("planning_scene")
        self.table = cell.file.table
        files = (cell.object, *load_further_objects(cell))
        self.sizes = {file.name: (file.height, file.shape.reach()) for file in files}
        self.states, self.added = ObjectStates(), set[str]()
        self.scene = self.create_publisher(PlanningScene, "planning_scene", 10)
        self.create_subscription(ObjectStates, "object_states", self.on_states, LATCHED)
        self.create_timer(1.0, self.publish)

    def on_states(self, message: ObjectStates) -> None:
        """Keep the last states."""
        self.states = message

    def publish(self) -> None:
        """Publish the table and the objects that are seen; remove those that are gone."""
        middle = Pose()
        middle.position.z = -THICKNESS / 2
        size = [self.table.length, self.table.width, THICKNESS]
        found = [self.solid("table", SolidPrimitive.BOX, size, middle)]
        for state in self.states.objects:
            name, pose = state.object_id, state.pose.pose
            height, radius = self.sizes[name]
            pose.position.z = height / 2
            one = self.solid(name, SolidPrimitive.CYLINDER, [height, radius], pose)
            if state.visible:
                self.added.add(name)
                found.append(one)
            elif name in self.added and not state.hidden_by_arm:
                self.added.remove(name)
                one.operation = CollisionObject.REMOVE
                found.append(one)
        scene = PlanningScene(is_diff=True)
        scene.robot_state.is_diff = True  # otherwise MoveIt would detach what the arm holds
        scene.world.collision_objects = found
        self.scene.publish(scene)

    def solid(self, name: str, kind: int, dimensions: list[float], pose: Pose) -> CollisionObject:
        """Return a collision object; ``dimensions`` as in SolidPrimitive, m; ``pose`` in table."""
        made = CollisionObject(id=name, operation=CollisionObject.ADD)
        made.header.frame_id = "table"
        made.primitives = [SolidPrimitive(type=kind, dimensions=dimensions)]
        made.pose.orientation.w = 1.0
        made.primitive_poses = [pose]
        return made


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(ScenePublisher(load_cell(Path(sys.argv[1]))))
