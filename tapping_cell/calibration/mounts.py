"""Calibration of the line and speed of each fixed tapper from single taps measured by the camera.

A tap gives three numbers: the object's direction of travel, its rotation per distance and its
distance. The direction and the rotation depend on the offset and angle of the tapper's line, and
the distance depends on the striker's speed. For each tapper, three unknowns (offset of the line to
the left in m, angle of the line in rad, and logarithm of the speed factor) are fitted to all taps
of this tapper by least squares. The weights come from the tap's scatter and the camera's noise, and
the soft-l1 loss reduces the effect of outliers. Taps at one position of the object determine the
line's offset at this position. To determine the line's angle, taps at several positions along the
line are needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.csv_table import Column
from tapping_cell.mechanics import Tap
from tapping_cell.se2 import Array, Pose, wrap_angle

RECORD_COLUMNS = (
    Column("speed", "m/s", 0.001, 50.0),
    Column("x_before", "m", -5.0, 5.0),
    Column("y_before", "m", -5.0, 5.0),
    Column("theta_before", "rad", -7.0, 7.0),
    Column("x_after", "m", -5.0, 5.0),
    Column("y_after", "m", -5.0, 5.0),
    Column("theta_after", "rad", -7.0, 7.0),
)

MIN_TAPS = 4
"""Minimum number of usable taps of each tapper."""

MIN_MOVE = 0.003
"""Minimum displacement of a usable tap, in m. For smaller displacements, the camera's noise is the
largest error."""

WIDEST = np.array([0.003, math.radians(2.0), 0.5])
"""Prior standard deviations of the three unknowns (m, rad, relative), for mounts set up with ruler
and protractor."""

LARGEST_TURN = math.radians(20.0)
"""Angle, in rad, between the measured and the fitted direction of travel beyond which a tap does
not fit. An error of the contact friction turns it by less."""

MAX_DEVIATION = 0.0003
"""Maximum standard deviation, in m, of the line's offset at the object, up to which the fitted line
may be used for planning."""


@dataclass(frozen=True, slots=True)
class TapScatter:
    """Standard deviations of a tap and of one camera measurement.

    ``distance`` and ``rotation`` are relative, ``direction`` and ``camera_angle`` in rad,
    ``camera_position`` in m. ``position_floor`` (m) and ``angle_floor`` (rad) are the parts that
    do not depend on the size of the tap.
    """

    distance: float
    rotation: float
    direction: float
    camera_position: float
    camera_angle: float
    position_floor: float = 0.0
    angle_floor: float = 0.0


@dataclass(frozen=True, slots=True)
class MountFit:
    """Result for one tapper; ``mount`` is the tapper's measured line.

    ``offset`` in m and ``angle`` in rad are corrections of the nominal mount. ``speed_factor`` is
    the ratio of true to commanded speed. ``line_offset`` in m is the offset of the line at the
    object, and ``line_deviation`` is its standard deviation; ``angle_deviation`` in rad is the
    standard deviation of the angle. ``residual`` is the root mean square of the weighted residuals
    (about 1 if the assumed scatter is correct).
    """

    name: str
    mount: Pose
    offset: float
    angle: float
    speed_factor: float
    line_offset: float
    line_deviation: float
    angle_deviation: float
    residual: float
    taps: int
    left_out: int

    @property
    def taps_wanted(self) -> int:
        """Approximate total number of taps needed to reach ``MAX_DEVIATION``."""
        return max(self.taps, math.ceil(self.taps * (self.line_deviation / MAX_DEVIATION) ** 2))


def fit_mount(
    name: str,
    nominal: Pose,
    tap: Tap,
    speeds: Array,
    before: Array,
    after: Array,
    scatter: TapScatter,
) -> MountFit:
    """Fit one tapper to its taps.

    Args:
        name: name of the tapper.
        nominal: mount of the tapper in the cell file.
        tap: mechanics of the object and this tapper's striker.
        speeds: commanded speeds (n,), m/s.
        before, after: poses (n, 3) of the object at rest, m and rad.
        scatter: standard deviations of taps and camera measurements.

    Raises:
        CalibrationRefused: too few taps moved the object, or the taps contradict the mount in the
            cell file.
    """
    moved = after - before
    moved[:, 2] = wrap_angle(moved[:, 2])
    size = np.hypot(moved[:, 0], moved[:, 1])
    used = size >= MIN_MOVE
    if int(used.sum()) < MIN_TAPS:
        raise CalibrationRefused(
            f"tapper '{name}': {int(used.sum())} of {speeds.size} taps moved the object by "
            f"{1e3 * MIN_MOVE:.0f} mm or more; at least {MIN_TAPS} are needed"
        )
    speeds, before, moved, size = speeds[used], before[used], moved[used], size[used]
    place = math.hypot(math.sqrt(2.0) * scatter.camera_position, scatter.position_floor) / size
    weight = np.stack(
        [
            np.hypot(scatter.direction, place),
            np.hypot(
                math.hypot(scatter.rotation, scatter.distance)
                * np.maximum(np.abs(moved[:, 2] / size), 0.5),
                math.hypot(math.sqrt(2.0) * scatter.camera_angle, scatter.angle_floor) / size,
            ),
            np.hypot(scatter.distance, place),
        ],
        axis=-1,
    )
    measured_heading = np.arctan2(moved[:, 1], moved[:, 0])
    towards = np.cos(measured_heading - nominal.theta) < 0.0
    if 2 * towards.sum() > towards.size:
        raise CalibrationRefused(
            f"tapper '{name}': {int(towards.sum())} of {towards.size} taps moved the object "
            "towards the tapper; check whether the poses before and after the tap are exchanged, "
            "and the tapper's 'direction' in the cell file"
        )

    def outcome(unknown: Array) -> Array:
        line = _moved(nominal, unknown[0], unknown[1])
        return tap.outcome(
            before, np.array([line.x, line.y, line.theta]), speeds * math.exp(unknown[2])
        )

    def residuals(unknown: Array) -> Array:
        predicted = outcome(unknown)
        length = np.hypot(predicted[:, 0], predicted[:, 1])
        hit = length > 0.0
        safe = np.where(hit, length, 1.0)
        each = np.stack(
            [
                wrap_angle(measured_heading - np.arctan2(predicted[:, 1], predicted[:, 0])),
                moved[:, 2] / size - predicted[:, 2] / safe,
                np.log(size / safe),
            ],
            axis=-1,
        )
        each = np.where(hit[:, None], each / weight, 10.0)
        return np.concatenate([each.reshape(-1), unknown / WIDEST])

    found = least_squares(
        residuals,
        np.zeros(3),
        loss="soft_l1",
        x_scale=np.array([1e-4, 1e-3, 1e-2]),
        diff_step=1e-4,
    )
    path = outcome(found.x)
    turn = wrap_angle(measured_heading - np.arctan2(path[:, 1], path[:, 0]))
    astray = (np.hypot(path[:, 0], path[:, 1]) == 0.0) | (np.abs(turn) > LARGEST_TURN)
    if 2 * astray.sum() > astray.size:
        raise CalibrationRefused(
            f"tapper '{name}': {int(astray.sum())} of {astray.size} taps moved the object in "
            f"directions more than {math.degrees(LARGEST_TURN):.0f} degrees away from those of any "
            "line near the tapper's mount; check that this tapper made them, the units of the "
            "record, and the tapper's 'position' and 'direction' in the cell file"
        )
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    offset, angle, speed = (float(value) for value in found.x)
    mount = _moved(nominal, offset, angle)
    reach = np.hypot(before[:, 0] - mount.x, before[:, 1] - mount.y).mean() - (
        tap.body.bounding_radius
    )
    lever = np.array([1.0, float(reach), 0.0])
    residual = float(np.sqrt(np.mean(residuals(found.x)[:-3] ** 2)))
    spread = max(1.0, residual)
    return MountFit(
        name=name,
        mount=mount,
        offset=offset,
        angle=angle,
        speed_factor=math.exp(speed),
        line_offset=float(lever @ found.x),
        line_deviation=spread * math.sqrt(float(lever @ covariance @ lever)),
        angle_deviation=spread * math.sqrt(float(covariance[1, 1])),
        residual=residual,
        taps=int(used.sum()),
        left_out=int((~used).sum()),
    )


def _moved(mount: Pose, offset: float, angle: float) -> Pose:
    return Pose(
        mount.x - float(offset) * math.sin(mount.theta),
        mount.y + float(offset) * math.cos(mount.theta),
        mount.theta + float(angle),
    )
