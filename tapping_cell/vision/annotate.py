"""The frame with what the cell makes of it drawn in: for people."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.se2 import Pose, transform_points
from tapping_cell.vision.camera import Array, Image, View
from tapping_cell.vision.observation import Observation

Colour = tuple[int, int, int]

GREEN: Colour = (90, 220, 90)
AMBER: Colour = (40, 180, 255)
RED: Colour = (70, 70, 240)
BLUE: Colour = (255, 170, 70)
WHITE: Colour = (245, 245, 245)
_FINE = 4
"""Fractional bits of OpenCV's drawing coordinates."""


def annotate(
    image: Image,
    view: View | None,
    observation: Observation,
    outline: ArrayLike,
    height: float,
    goal: Pose | None = None,
) -> NDArray[np.uint8]:
    """A colour picture (BGR, uint8, height x width x 3) of one frame and its observation.

    ``outline`` (N, 2) is the object's in its own frame, in m, ``height`` (m) that of its top;
    ``goal`` the pose in table where it should be. Text is in mm and degrees.
    """
    picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    points = np.asarray(outline, dtype=float)
    if view is not None:
        _axes(picture, view, Pose(0.0, 0.0, 0.0), 0.0, 0.06)
        if goal is not None:
            _outline(picture, view, points, goal, height, BLUE, 2)
            _axes(picture, view, goal, height, 0.03, BLUE)
        if observation.pose is not None:
            colour = GREEN if observation.at_rest else AMBER
            _outline(picture, view, points, observation.pose, height, colour, 2)
            _axes(picture, view, observation.pose, height, 0.03)
    _caption(picture, observation, goal)
    return picture


def _outline(
    picture: NDArray[np.uint8],
    view: View,
    points: Array,
    pose: Pose,
    height: float,
    colour: Colour,
    width: int,
) -> None:
    corners = _fixed(view.project(transform_points(pose, points), height))
    cv2.polylines(picture, [corners], True, colour, width, cv2.LINE_AA, _FINE)


def _axes(
    picture: NDArray[np.uint8],
    view: View,
    pose: Pose,
    height: float,
    length: float,
    colour: Colour | None = None,
) -> None:
    ends = transform_points(pose, [[0.0, 0.0], [length, 0.0], [0.0, length]])
    origin, x, y = (tuple(int(c) for c in p) for p in _fixed(view.project(ends, height)))
    cv2.arrowedLine(picture, origin, x, colour or RED, 2, cv2.LINE_AA, _FINE, 0.15)
    cv2.arrowedLine(picture, origin, y, colour or GREEN, 2, cv2.LINE_AA, _FINE, 0.15)


def _fixed(pixels: Array) -> NDArray[np.int32]:
    return np.asarray(np.round(np.clip(pixels, -4000, 8000) * 2**_FINE), dtype=np.int32)


def _caption(picture: NDArray[np.uint8], observation: Observation, goal: Pose | None) -> None:
    lines: list[tuple[str, Colour]] = []
    pose = observation.pose
    if pose is not None and observation.covariance is not None:
        state = "AT REST" if observation.at_rest else "MOVING"
        colour = GREEN if observation.at_rest else AMBER
        frames = f"   {observation.frames_fused} frames" if observation.at_rest else ""
        lines.append((f"{state}{frames}", colour))
        sigma = np.sqrt(np.diag(observation.covariance))
        lines.append(
            (
                f"x {pose.x * 1e3:+.2f}  y {pose.y * 1e3:+.2f} mm   "
                f"theta {math.degrees(pose.theta):+.2f} deg   "
                f"(sd {max(sigma[:2]) * 1e3:.3f} mm, {math.degrees(sigma[2]):.3f} deg)",
                WHITE,
            )
        )
        if goal is not None:
            lines.append(
                (
                    f"to the goal: {pose.distance_to(goal) * 1e3:.2f} mm, "
                    f"{math.degrees(pose.rotation_to(goal)):+.2f} deg",
                    BLUE,
                )
            )
    if observation.sentence:
        colour = AMBER if observation.visible else RED
        lines.extend((text, colour) for text in _wrapped(observation.sentence, 90))
    scale = picture.shape[1] / 1280.0
    step = round(30 * scale)
    shade = picture[: step * len(lines) + round(12 * scale)]
    shade[:] = (shade * 0.35).astype(np.uint8)
    for row, (text, colour) in enumerate(lines):
        place = (round(14 * scale), step * (row + 1) - round(4 * scale))
        cv2.putText(
            picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.72 * scale, colour, 2, cv2.LINE_AA
        )


def _wrapped(text: str, width: int) -> list[str]:
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + len(word) >= width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines
