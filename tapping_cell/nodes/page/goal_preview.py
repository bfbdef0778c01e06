"""Previews of goals and of the planned tap on the camera's image, while a page is open."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo
from tapping_cell_msgs.msg import PlannedTap

from tapping_cell.logic.poses import covariance_from_message
from tapping_cell.nodes.camera import images
from tapping_cell.nodes.camera.pose_messages import camera_from_message
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.conversions import from_message, is_finite
from tapping_cell.nodes.page.arrangements import Arrangements
from tapping_cell.nodes.page.ghost import Ghost
from tapping_cell.nodes.page.requests import BadRequest, Move, Place, Turn
from tapping_cell.nodes.page.server import Answer
from tapping_cell.se2 import Pose
from tapping_cell.vision import CameraError, CameraModel, View

Asked = TypeVar("Asked")

_logger = logging.getLogger(__name__)


class Previews(Generic[Asked]):
    """Process requests of the pages in a separate thread.

    Only the newest request of each page is kept, because a drag makes earlier requests obsolete.
    Pages are served in turn, so that a page with many requests does not delay the others.
    """

    def __init__(self, serve: Callable[[Asked], None]) -> None:
        self._serve = serve
        self._waiting: dict[object, Asked] = {}
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="goal previews", daemon=True)
        self._thread.start()

    def ask(self, page: object, asked: Asked) -> None:
        """Queue a page's request. A newer request of the same page replaces it."""
        with self._changed:
            self._waiting[page] = asked  # a page that is already waiting keeps its position
            self._changed.notify()

    def close(self) -> None:
        """End the thread after its current request."""
        with self._changed:
            self._closing = True
            self._waiting.clear()
            self._changed.notify()
        self._thread.join(2.0)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                if self._closing:
                    return
                page = next(iter(self._waiting))
                asked = self._waiting.pop(page)
            try:
                self._serve(asked)
            except Exception:
                # A defect in one preview must not end the thread.
                _logger.exception("a goal's preview failed")


class GoalPreview:
    """Ghosts of the cell's objects. Called in the executor's thread, except for ``ask``."""

    def __init__(self, node: Node, arrangements: Arrangements) -> None:
        self._node = node
        self._arrangements = arrangements
        self._camera: CameraModel | None = None
        self._camera_info: Subscription | None = None
        self._ghosts: dict[str, Ghost] = {}
        self._drawn: tuple[int, dict[str, object]] | None = None
        """Id and drawing of the planned tap that was drawn last."""
        self._previews: Previews[tuple[Move | Turn | Place, Answer]] | None = None

    def start(self) -> None:
        """Start to answer requests, in a separate thread."""
        self._previews = Previews(self._answer)

    def close(self) -> None:
        """End the thread."""
        if self._previews is not None:
            self._previews.close()
            self._previews = None

    def subscribe(self) -> list[Subscription]:
        """Subscribe to the camera's calibration and pose."""
        subscribe = self._node.create_subscription
        self._camera_info = subscribe(
            CameraInfo, "camera/camera_info", self._on_camera_info, images.PICTURES
        )
        return [subscribe(PoseStamped, "camera/pose", self._on_camera_pose, LATCHED)]

    def forget(self) -> None:
        """Discard the ghosts when no page is open."""
        self._drop_camera_info()
        self._ghosts = {}

    @property
    def is_possible(self) -> bool:
        """Whether the camera's pose is known."""
        return bool(self._ghosts)

    def ask(self, page: object, request: Move | Turn | Place, answer: Answer) -> None:
        """Send a page the pose and drawing of a ghost. May be called from any thread."""
        if request.object not in ("", *self._arrangements.cells):
            answer(_failure(request, f"the cell has no object '{request.object}'"))
        elif self._previews is not None:
            self._previews.ask((page, request.object), (request, answer))

    def planned(self, tap: PlannedTap | None, name: str) -> dict[str, object] | None:
        """Return the drawing of a planned tap of the object ``name``, in fractions of the image
        size; None if there is no tap or the camera's pose is unknown. Computed once per tap."""
        ghost = self._ghost_of(name) or self._ghost_of("")
        if tap is None or ghost is None:
            self._drawn = None
            return None
        if self._drawn is None or self._drawn[0] != tap.tap_id:
            drawing = ghost.planned(
                from_message(tap.object_pose),
                from_message(tap.strike_pose),
                from_message(tap.predicted_pose.pose),
                covariance_from_message(tap.predicted_pose.covariance)[:2, :2],
            )
            self._drawn = tap.tap_id, drawing
        return self._drawn[1]

    def at(self, name: str, pose: Pose) -> dict[str, object] | None:
        """Return the drawing of an object at a pose; None while the camera's pose is unknown."""
        ghost = self._ghosts.get(name)
        return None if ghost is None else ghost.at(pose)

    def _answer(self, asked: tuple[Move | Turn | Place, Answer]) -> None:
        """Answer a request. Called in the previews' thread."""
        request, answer = asked
        try:
            ghost = self._ghost_of(request.object)
            if ghost is None:
                raise BadRequest(
                    "the camera's pose above the table is not known yet; type the goal instead"
                )
            answer(ghost.answer(request))
        except BadRequest as error:
            answer(_failure(request, str(error)))

    def _ghost_of(self, name: str) -> Ghost | None:
        """Return the ghost of an object, or of the cell's own object if ``name`` is empty; None
        while the camera's pose is unknown."""
        ghosts = self._ghosts
        return ghosts.get(name) if name else next(iter(ghosts.values()), None)

    def _on_camera_info(self, message: CameraInfo) -> None:
        """Store the calibration. One message suffices, because all images have the same
        calibration."""
        try:
            self._camera = images.from_camera_info(message)
        except CameraError:
            return
        self._drop_camera_info()

    def _drop_camera_info(self) -> None:
        if self._camera_info is not None:
            self._node.destroy_subscription(self._camera_info)
            self._camera_info = None

    def _on_camera_pose(self, message: PoseStamped) -> None:
        if self._camera is None or not is_finite(message.pose):
            return
        view = View(self._camera, camera_from_message(message.pose))
        self._ghosts = {
            name: Ghost(
                view,
                np.asarray(cell.outline()),
                cell.object.height,
                self._arrangements.checks[name].refusal_if_ready,
            )
            for name, cell in self._arrangements.cells.items()
        }


def _failure(request: Move | Turn | Place, sentence: str) -> dict[str, object]:
    head = {"type": "ghost", "number": request.number, "object": request.object}
    return {**head, "trouble": sentence}
