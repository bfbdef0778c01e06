"""Description of one tap in a few sentences: expected and measured results, and its purpose."""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.report.run import TapRow
from tapping_cell.report.words import expected_effort, remaining_error
from tapping_cell.se2 import Pose, wrap_angle

WITHIN_95 = 7.81
"""95 % quantile of the chi-squared distribution with three degrees of freedom."""
BESIDE = math.radians(25.0)
"""Maximum angle between a tap and the direction to the goal for the tap to count as aimed at the
goal."""
FARTHER = 1.15
"""A tap whose travel exceeds this multiple of the distance to the goal overshoots on purpose."""
SHORTER = 0.85
"""A tap whose travel is below this multiple of the distance to the goal stops short on purpose."""


def tap_sentence(tap: TapRow, goal: Pose | None) -> str:
    """Describe a tap for the user, in mm and degrees."""
    parts = [f"Tapper '{tap.tapper}'." if tap.tapper else "", _moved(tap)]
    if goal is not None:
        parts.append(_purpose(tap, goal))
        if tap.seen:
            parts.append(
                f"Remaining error before the tap: {remaining_error(tap.before, goal)}; after it: "
                f"{remaining_error(tap.measured, goal)}."
            )
    elif tap.reason:
        parts.append(f"Chosen because {tap.reason}.")
    effort = expected_effort(tap.expected_taps, tap.expected_seconds)
    if effort:
        parts.append(f"Before this tap, the planner expected to reach the goal in {effort}.")
    return " ".join(part for part in parts if part)


def _moved(tap: TapRow) -> str:
    expected = f"Expected to move the object by {_move(tap.before, tap.predicted)}"
    if not tap.seen:
        return f"{expected}; the object was not seen afterwards."
    return f"{expected}; measured {_move(tap.before, tap.measured)}{_agreement(tap)}."


def _agreement(tap: TapRow) -> str:
    """Describe the agreement of measurement and prediction; empty without a covariance."""
    if tap.predicted_covariance is None:
        return ""
    covariance = np.array(tap.predicted_covariance)
    off = np.array(tap.measured) - np.array(tap.predicted)
    off[2] = wrap_angle(off[2])
    distance = float(off @ np.linalg.pinv(covariance, hermitian=True) @ off)
    if distance <= WITHIN_95:
        return ", within the scatter of a tap"
    return ", outside the range of 95 % of taps; the next taps take this result into account"


def _purpose(tap: TapRow, goal: Pose) -> str:
    """Describe whether the tap aims at the goal, past it or away from it; empty for a tap to the
    side."""
    if tap.reason:
        return f"This tap is not aimed straight at the goal, because {tap.reason}."
    to_goal = np.array([goal.x - tap.before.x, goal.y - tap.before.y])
    move = np.array([tap.predicted.x - tap.before.x, tap.predicted.y - tap.before.y])
    away, length = float(np.hypot(*to_goal)), float(np.hypot(*move))
    if away <= 0.0 or length <= 0.0:
        return ""
    turn = math.degrees(abs(tap.before.rotation_to(tap.predicted)))
    needs = f"a rotation of {turn:.1f} deg requires a travel of {1000 * length:.1f} mm"
    along = float(wrap_angle(math.atan2(move[1], move[0]) - math.atan2(to_goal[1], to_goal[0])))
    if abs(along) > math.pi - BESIDE:
        return (
            f"The tap moves the object away from the goal on purpose: {needs}, and the next tap "
            "returns the object."
        )
    if abs(along) > BESIDE:
        return ""
    if length > FARTHER * away:
        return (
            f"The tap moves the object past the goal on purpose: {needs}, and the goal was "
            f"{1000 * away:.1f} mm away; the next tap returns the object."
        )
    if length < SHORTER * away:
        return (
            f"The tap stops {1000 * (away - length):.1f} mm short of the goal on purpose: a "
            "shorter tap scatters less, and the last tap can still turn the object."
        )
    return "The tap is aimed straight at the goal."


def _move(before: Pose, after: Pose) -> str:
    turn = math.degrees(before.rotation_to(after))
    return f"{1000 * before.distance_to(after):.1f} mm and {turn:+.1f} deg"
