"""Draw the measurements and the goal into a camera frame, for display."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.se2 import Pose, transform_points
from tapping_cell.vision.camera import Array, Image, View
from tapping_cell.vision.markers.detection import ReferenceMap
from tapping_cell.vision.observation import Observation, Problem

Colour = tuple[int, int, int]

GREEN: Colour = (90, 220, 90)
AMBER: Colour = (40, 180, 255)
RED: Colour = (70, 70, 240)
BLUE: Colour = (255, 170, 70)
WHITE: Colour = (245, 245, 245)
_TABLE = Pose(0.0, 0.0, 0.0)
_FINE = 4
"""Number of fractional bits in OpenCV's drawing coordinates."""


def annotate(
    image: Image,
    view: View | None,
    observation: Observation,
    outline: ArrayLike,
    height: float,
    goal: Pose | None = None,
    references: ReferenceMap | None = None,
    unknown: Sequence[Array] = (),
    name: str = "",
) -> NDArray[np.uint8]:
    """Return a colour image (BGR, uint8, height x width x 3) of one frame and its observation.

    ``outline`` (N, 2) is the object's outline in its own frame, in m, and ``height`` (m) the height
    of its top. ``goal`` is the object's goal pose in ``table``. ``references`` are drawn at their
    positions in the table file: in blue if they were used in this frame, otherwise in red.
    ``unknown`` are the outlines (N, 2) in ``table`` of the objects without an object file; they are
    drawn in red. ``name`` of the object precedes its state. Text is in mm and degrees.
    """
    picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    points = np.asarray(outline, dtype=float)
    if view is not None:
        if references is not None:
            _references(picture, view, references, observation.references_used)
        for one in unknown:
            _outline(picture, view, one, _TABLE, 0.0, RED)
        _axes(picture, view, _TABLE, 0.0, 0.06)
        if goal is not None:
            _outline(picture, view, points, goal, height, BLUE)
            _axes(picture, view, goal, height, 0.03, BLUE)
        if observation.pose is not None:
            _outline(picture, view, points, observation.pose, height, _state(observation)[1])
            _axes(picture, view, observation.pose, height, 0.03)
    _caption(picture, observation, goal, name)
    return picture


def _state(observation: Observation) -> tuple[str, Colour]:
    """Return label and colour of the object's state. The label is FOUND after the first frame,
    because one frame does not show whether the object moves."""
    if observation.at_rest:
        return f"AT REST   {observation.frames_fused} frames", GREEN
    if observation.velocity is not None and not observation.velocity.any():
        return "FOUND", GREEN
    return "MOVING", AMBER


def _references(
    picture: NDArray[np.uint8], view: View, references: ReferenceMap, used: tuple[int, ...]
) -> None:
    scale = _scale(picture)
    for marker, corners in zip(references.markers, references.corners(), strict=True):
        colour = BLUE if marker.id in used else RED
        _outline(picture, view, np.asarray(corners), _TABLE, 0.0, colour)
        x, y = (int(c) for c in np.clip(view.project(corners).mean(axis=0), -4000, 8000))
        place = (x - round(9 * scale * len(str(marker.id))), y + round(10 * scale))
        # Outlined text is readable on black and on white modules.
        for ink, width in (((0, 0, 0), 6), (colour, 2)):
            width, font = max(1, round(width * scale)), cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(picture, str(marker.id), place, font, 0.8 * scale, ink, width, cv2.LINE_AA)


def _scale(picture: NDArray[np.uint8]) -> float:
    """Scale of lines and letters: 1 for an image 1280 pixels wide, at least 0.6 for legibility."""
    return max(picture.shape[1] / 1280.0, 0.6)


def _outline(
    picture: NDArray[np.uint8],
    view: View,
    points: Array,
    pose: Pose,
    height: float,
    colour: Colour,
) -> None:
    corners = _fixed(view.project(transform_points(pose, points), height))
    width = max(1, round(2 * _scale(picture)))
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
    width = max(1, round(2 * _scale(picture)))
    cv2.arrowedLine(picture, origin, x, colour or RED, width, cv2.LINE_AA, _FINE, 0.15)
    cv2.arrowedLine(picture, origin, y, colour or GREEN, width, cv2.LINE_AA, _FINE, 0.15)


def _fixed(pixels: Array) -> NDArray[np.int32]:
    return np.asarray(np.round(np.clip(pixels, -4000, 8000) * 2**_FINE), dtype=np.int32)


def _caption(
    picture: NDArray[np.uint8], observation: Observation, goal: Pose | None, name: str
) -> None:
    texts: list[tuple[str, Colour]] = []
    pose = observation.pose
    if pose is not None and observation.covariance is not None:
        sigma = np.sqrt(np.diag(observation.covariance))
        values = (
            f"x {pose.x * 1e3:+.2f}  y {pose.y * 1e3:+.2f} mm   "
            f"theta {math.degrees(pose.theta):+.2f} deg   "
            f"(sd {max(sigma[:2]) * 1e3:.3f} mm, {math.degrees(sigma[2]):.3f} deg)"
        )
        state, colour = _state(observation)
        texts += [(f"{name}   {state}".lstrip(), colour), (values, WHITE)]
        if goal is not None:
            distance, rotation = pose.distance_to(goal), pose.rotation_to(goal)
            left = f"to the goal: {distance * 1e3:.2f} mm, {math.degrees(rotation):+.2f} deg"
            texts.append((left, BLUE))
    if observation.sentence:
        expected = observation.problem is Problem.NONE and not observation.visible
        colour = WHITE if expected else AMBER if observation.visible else RED
        texts.append((observation.sentence, colour))
    scale = _scale(picture)
    letters = int(90 * picture.shape[1] / 1280.0 / scale)
    lines = [(line, colour) for text, colour in texts for line in _wrapped(text, letters)]
    step = round(30 * scale)
    shade = picture[: step * len(lines) + round(12 * scale)]
    shade[:] = (shade * 0.35).astype(np.uint8)
    for row, (text, colour) in enumerate(lines):
        place = (round(14 * scale), step * (row + 1) - round(4 * scale))
        width = max(1, round(2 * scale))
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(picture, text, place, font, 0.72 * scale, colour, width, cv2.LINE_AA)


def _wrapped(text: str, width: int) -> list[str]:
    lines = [""]
    for word in text.split(" "):
        if lines[-1] and len(lines[-1]) + len(word) >= width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}" if lines[-1] else word
    return lines
