"""What was learnt about an object, in physical words."""

from __future__ import annotations

import math
from collections.abc import Mapping

import yaml

from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.configuration.schema import ConfigurationError, build
from tapping_cell.report.run import Launch, Learnt


def object_of(files: Mapping[str, str], name: str) -> ObjectFile | None:
    """Return the object with a name from the texts of a run's files; None if it is not there."""
    for path, text in files.items():
        try:
            content = yaml.safe_load(text)
            if isinstance(content, dict) and content.get("name") == name and "shape" in content:
                return build(ObjectFile, content, path)
        except (yaml.YAMLError, ConfigurationError):
            continue
    return None


def learnt_words(learnt: Learnt, known: ObjectFile | None) -> str:
    """Describe the friction, the torque factor and the impact that explain the slides so far.

    ``known``: the planner's object; None gives ratios to its file.
    """
    friction = 1.0 / learnt.slide_distance
    off = learnt.slide_distance_deviation / learnt.slide_distance * friction
    words = [f"friction {friction:.2f} \u00b1 {off:.2f} times that of the object's file"]
    if known is not None:
        mu, gamma = known.friction, known.body().gamma
        words = [f"friction {mu * friction:.3f} \u00b1 {mu * off:.3f} (object file {mu:g})"]
        # The rotation per distance is inverse to 1 + gamma kappa / 4 (docs/mechanics.md).
        power = 1.0 + gamma * known.torque_factor / 4.0
        gain = max(learnt.slide_rotation, 1e-3)
        torque = max(0.0, 4.0 / gamma * (power / gain - 1.0))
        spread = 4.0 / gamma * power / gain**2 * learnt.slide_rotation_deviation
        words.append(
            f"torque factor {torque:.2f} \u00b1 {spread:.2f} (object file {known.torque_factor:g})"
        )
    speed = 100.0 * (math.sqrt(learnt.impact_distance) - 1.0)
    off = 50.0 * learnt.impact_distance_deviation / math.sqrt(learnt.impact_distance)
    words.append(f"impact {_compared(speed, 'faster', 'slower')} (\u00b1 {off:.1f} %)")
    return "; ".join(words)


def launch_words(launch: Launch) -> str:
    """Describe the launch in the track of a slide beside that of the model."""
    speed = 100.0 * (launch.speed / launch.model_speed - 1.0)
    words = [
        f"{1e3 * launch.speed:.0f} \u00b1 {1e3 * launch.speed_deviation:.0f} mm/s, "
        f"{_compared(speed, 'faster', 'slower')} ({1e3 * launch.model_speed:.0f} mm/s)"
    ]
    if math.isfinite(launch.spin):
        words.append(
            f"{math.degrees(launch.spin):.0f} \u00b1 {math.degrees(launch.spin_deviation):.0f} "
            f"deg/s (model {math.degrees(launch.model_spin):.0f} deg/s)"
        )
    words.append(
        f"deceleration {launch.deceleration:.2f} \u00b1 {launch.deceleration_deviation:.2f} "
        f"m/s\u00b2 (model {launch.model_deceleration:.2f} m/s\u00b2), "
        f"from {launch.poses:.0f} poses"
    )
    return "; ".join(words)


def _compared(percent: float, more: str, less: str) -> str:
    if abs(percent) < 0.5:
        return "as fast as the model"
    return f"{abs(percent):.0f} % {more if percent > 0.0 else less} than the model"
