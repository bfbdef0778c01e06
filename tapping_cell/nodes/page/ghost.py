"""Goal preview ("ghost"): an outline of the object that a person drags over the image to set a
goal.

The camera's model and pose map a pixel to a point at the height of the object's top, and back. An
image point (u, v) is given in fractions of the image's width and height from the top left corner,
so that the page may show the image at any size.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.nodes.page.requests import BadRequest, Move, Place, Turn
from tapping_cell.se2 import Pose, transform_points
from tapping_cell.vision import View

HANDLE_BEYOND = 0.03
"""Distance, m, of the rotation handle beyond the farthest point of the outline."""
ARROW, ARROW_AHEAD = 0.06, 0.012
"""Lengths in m of the two parts of the line that represents the striker: ``ARROW`` behind the
position of the striker's tip at rest, and ``ARROW_AHEAD`` in front of this position."""
ELLIPSE_95 = math.sqrt(-2.0 * math.log(0.05))
"""Radius of the ellipse that contains 95 % of a bivariate normal distribution, in standard
deviations."""
FARTHEST = 5.0
"""Maximum distance in m from the table's origin. A pixel that maps to a point farther away does not
show the table."""
SIDE = 0.001
"""Step in m for determining the direction on the table that points to the right in the image."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Ghost:
    """Goal preview of an object: maps between image and table, and draws the outline at the goal.

    ``outline`` (N, 2) in the object's frame and ``height`` of the object's top are in m.
    ``refusal`` returns the planner's message for a goal that it would refuse, or an empty text.
    """

    view: View
    outline: Array
    height: float
    refusal: Callable[[Pose], str]

    def answer(self, request: Move | Turn | Place) -> dict[str, object]:
        """Return the ghost's pose (mm, degrees) and its drawing for the page.

        Raises:
            BadRequest: the pixel does not show the table.
        """
        pose = self.pose(request)
        x, y = pose.x, pose.y
        handle = transform_points(pose, [[self._arm(), 0.0]])
        return {
            "type": "ghost",
            "number": request.number,
            "object": request.object,
            "x": round(1e3 * x, 2),
            "y": round(1e3 * y, 2),
            "angle": round(math.degrees(math.remainder(pose.theta, math.tau)), 2),
            **self.at(pose),
            "handle": self._seen(handle)[0],
            "right": self._right(x, y),
            "refusal": self.refusal(pose),
        }

    def planned(
        self, before: Pose, strike: Pose, predicted: Pose, covariance: Array
    ) -> dict[str, object]:
        """Return the drawing of a planned tap in fractions of the image size: the ``arrow`` of the
        striker, the predicted ``outline``, the ``way`` (predicted path of the object's centre), and
        the ``ellipse`` that contains the centre with a probability of 95 %. ``covariance`` (2, 2)
        of the predicted centre is in m^2."""
        values, axes = np.linalg.eigh(covariance)
        radii = ELLIPSE_95 * np.sqrt(np.maximum(values, 0.0))
        around = np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False)
        circle = np.column_stack([radii[0] * np.cos(around), radii[1] * np.sin(around)])
        centre = np.array([predicted.x, predicted.y])
        tip = [[-ARROW, 0.0], [ARROW_AHEAD, 0.0]]
        return {
            "arrow": self._seen(transform_points(strike, tip)),
            "outline": self._seen(transform_points(predicted, self.outline)),
            "way": self._seen([[before.x, before.y], [predicted.x, predicted.y]]),
            "ellipse": self._seen(centre + circle @ axes.T),
        }

    def at(self, pose: Pose) -> dict[str, object]:
        """Return the ``outline`` and the ``centre`` of the object at a pose, in fractions of the
        image size."""
        corners = self._seen(transform_points(pose, self.outline))
        return {"outline": corners, "centre": self._seen([[pose.x, pose.y]])[0]}

    def pose(self, request: Move | Turn | Place) -> Pose:
        """Return the pose that a request refers to.

        Raises:
            BadRequest: the pixel does not show the table.
        """
        if isinstance(request, Place):
            return request.pose
        x, y = self._place(request.u, request.v)
        if isinstance(request, Move):
            return Pose(x, y, request.angle)
        return Pose(request.x, request.y, math.atan2(y - request.y, x - request.x))

    def _arm(self) -> float:
        return float(np.max(np.hypot(*self.outline.T))) + HANDLE_BEYOND

    def _size(self) -> Array:
        return np.array([self.view.camera.width, self.view.camera.height], dtype=float)

    def _place(self, u: float, v: float) -> tuple[float, float]:
        # Pixel coordinates have their origin at the centre of the first pixel.
        pixel = np.array([u, v]) * self._size() - 0.5
        with np.errstate(all="ignore"):
            x, y = (float(value) for value in self.view.on_plane(pixel, self.height))
        if not math.hypot(x, y) < FARTHEST:
            raise BadRequest("that point of the image is not on the table")
        return x, y

    def _seen(self, points: ArrayLike) -> list[list[float]]:
        with np.errstate(all="ignore"):
            shares = (self.view.project(points, self.height) + 0.5) / self._size()
        near = np.clip(np.nan_to_num(shares, nan=-9.0), -9.0, 9.0)
        return [[round(float(u), 5), round(float(v), 5)] for u, v in near]

    def _right(self, x: float, y: float) -> int:
        """Return which of the directions 0, 90, 180 and -90 degrees on the table points most to the
        right in the image.

        The page uses this direction for the arrow keys: each key moves the ghost along an axis of
        the table, namely the axis that points approximately in the direction of the key in the
        image.
        """
        ends = [[x, y], [x + SIDE, y], [x, y + SIDE]]
        here, along_x, along_y = self.view.project(ends, self.height)
        by_x, by_y = float((along_x - here)[0]), float((along_y - here)[0])
        if abs(by_x) >= abs(by_y):
            return 0 if by_x > 0 else 180
        return 90 if by_y > 0 else -90
