"""Parameters of the simulated world that planners do not receive: ``config/truth/*.yaml``.

Factors multiply the values of the object, cell and camera files, and offsets are added to them, so
that one file applies to every object.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tapping_cell.configuration.objects import angle_floor_key, position_floor_key
from tapping_cell.configuration.schema import (
    ConfigurationError,
    choice,
    quantity,
    section,
    text,
)


def ratio(what: str, low: float, high: float) -> Any:
    """Declare a key for the ratio of one quantity to another, by default 1."""
    return quantity(f"ratio of {what}", "", low, high, default=1.0)


@dataclass(frozen=True, slots=True)
class SupportTruth:
    """True support of the object on the table."""

    friction_factor: float = ratio("the true to the configured friction", 0.1, 10.0)
    torque_factor_ratio: float = ratio("the true to the configured torque factor", 0.05, 20.0)
    pressure: str = choice(
        "distribution of the load: even over the whole underside, on the rim, on three points, or "
        "on a grid of pads",
        "even",
        "rim",
        "three_points",
        "pads",
        default="even",
    )
    edge_weight: float = quantity(
        "additional pressure at the rim, relative to the centre", "", 0.0, 20.0, default=0.0
    )
    feet_radius: float = quantity(
        "distance of the three points from the centre, as a fraction of the outline's distance "
        "from the centre in the same direction",
        "",
        0.05,
        1.0,
        default=0.8,
    )
    feet_turn: float = quantity(
        "direction of the first of the three points in the object's frame",
        "rad",
        -7.0,
        7.0,
        default=0.0,
    )
    pads: int = quantity("number of pads along the longer side of the object", "", 3, 40, default=9)
    pad_scatter: float = quantity(
        "standard deviation of the logarithm of a pad's load", "", 0.0, 3.0, default=0.5
    )
    pad_seed: int = quantity("random seed of the pads' loads", "", 0, 2**31 - 1, default=1)
    lean: tuple[float, float] = quantity(
        "relative increase of the underside's friction towards +x and +y of the object",
        "",
        -1.0,
        1.0,
        default=(0.0, 0.0),
    )
    mass_offset: tuple[float, float] = quantity(
        "x and y of the centre of mass in the object's frame", "m", -0.2, 0.2, default=(0.0, 0.0)
    )
    inertia_factor: float = ratio(
        "the true moment of inertia to that of a uniform object", 0.1, 3.0
    )
    slope: tuple[float, float] = quantity(
        "tilt of the table; positive values are downhill along +x and +y",
        "rad",
        -0.05,
        0.05,
        default=(0.0, 0.0),
    )


@dataclass(frozen=True, slots=True)
class PatchTruth:
    """A round patch of the table with different friction."""

    middle: tuple[float, float] = quantity("x and y in table", "m", -3.0, 3.0)
    radius: float = quantity("radius", "m", 0.001, 3.0)
    factor: float = quantity("ratio of the patch's friction to that of the table", "", 0.05, 20.0)


@dataclass(frozen=True, slots=True)
class SurfaceTruth:
    """Dependence of the table's friction on direction, speed and place."""

    anisotropy: float = ratio("the friction across the grain to that along it", 0.2, 5.0)
    grain: float = quantity(
        "direction of the grain in the frame table", "rad", -7.0, 7.0, default=0.0
    )
    slow_rise: float = quantity(
        "relative increase of the friction at very low speed", "", -0.9, 5.0, default=0.0
    )
    slow_speed: float = quantity(
        "speed at which slow_rise has decayed to 1/e",
        "m/s",
        0.001,
        5.0,
        default=0.02,
    )
    viscous: float = quantity(
        "relative increase of the friction per speed", "s/m", 0.0, 20.0, default=0.0
    )
    patches: tuple[PatchTruth, ...] = section(
        "patches with different friction; the factors of overlapping patches multiply", default=()
    )


@dataclass(frozen=True, slots=True)
class ImpactTruth:
    """True impact between striker and object."""

    restitution_factor: float = ratio("the true to the configured restitution", 0.1, 3.0)
    contact_friction_factor: float = ratio("the true to the configured contact friction", 0.1, 10.0)
    striker_speed_factor: float = ratio("the true to the commanded striker speed", 0.1, 3.0)
    gate_noise: float = quantity(
        "relative standard deviation of the tapper's speed measurement",
        "",
        0.0,
        0.2,
        default=0.0,
    )
    contact_time: float = quantity(
        "duration of a central elastic impact", "s", 0.00002, 0.005, default=0.0002
    )
    tangential_stiffness: float = quantity(
        "ratio of the contact's tangential to normal stiffness; 0 for rigid",
        "",
        0.0,
        2.0,
        default=0.0,
    )
    oblique_loss: float = quantity(
        "fraction of the restitution that a fully grazing impact loses; at an angle to the "
        "contact normal, an impact loses this fraction times the squared sine of the angle",
        "",
        0.0,
        1.0,
        default=0.0,
    )
    follow_through: float = quantity(
        "longest time from the first contact until the striker retracts; it retracts earlier if "
        "it reaches the end of its stroke",
        "s",
        0.0,
        2.0,
        default=0.1,
    )


@dataclass(frozen=True, slots=True)
class ScatterTruth:
    """Standard deviations of the random errors of each tap."""

    speed: float = quantity(
        "relative standard deviation of the launch speed", "", 0.0, 0.5, default=0.0
    )
    spin: float = quantity(
        "relative standard deviation of the launch spin", "", 0.0, 1.0, default=0.0
    )
    direction: float = quantity("standard deviation of the direction", "rad", 0.0, 0.5, default=0.0)
    position_floor: float = position_floor_key()
    angle_floor: float = angle_floor_key()


@dataclass(frozen=True, slots=True)
class ArmTruth:
    """True pose and motion errors of the arm."""

    base_offset: tuple[float, float, float] = quantity(
        "true minus configured pose of the arm's base: m, m, rad",
        "",
        -0.05,
        0.05,
        default=(0.0, 0.0, 0.0),
    )
    joint_offset: tuple[float, float, float, float] = quantity(
        "true minus reported joint positions: rad, rad, m, rad", "", -0.05, 0.05, default=(0.0,) * 4
    )
    backlash: tuple[float, float, float, float] = quantity(
        "backlash of the drives: rad, rad, m, rad", "", 0.0, 0.05, default=(0.0,) * 4
    )
    repeatability: tuple[float, float, float, float] = quantity(
        "repeatability: standard deviation of the joint positions at a target: rad, rad, m, rad",
        "",
        0.0,
        0.05,
        default=(0.0,) * 4,
    )
    holds: tuple[float, float, float] | None = quantity(
        "pose of the object on the striker while the arm holds it for calibration: m, m, rad",
        "",
        -7.0,
        7.0,
        default=None,
    )


@dataclass(frozen=True, slots=True)
class MountsTruth:
    """True lines of travel of fixed tappers, drawn at random around those of the cell file."""

    offset: float = quantity(
        "standard deviation of the lateral offset of a tapper's line",
        "m",
        0.0,
        0.01,
        default=0.0002,
    )
    angle: float = quantity(
        "standard deviation of the direction of a tapper's line", "rad", 0.0, 0.1, default=0.002
    )


@dataclass(frozen=True, slots=True)
class CameraTruth:
    """True parameters of the camera, compared with its calibration file."""

    position: tuple[float, float, float] = quantity(
        "position of the lens in the frame table", "m", -3.0, 3.0, default=(0.02, -0.015, 0.7)
    )
    aim: tuple[float, float] = quantity(
        "intersection of the optical axis with the table", "m", -3.0, 3.0, default=(0.0, 0.0)
    )
    turn: float = quantity(
        "rotation of the image about the optical axis", "rad", -7.0, 7.0, default=0.01
    )
    focal_factor: float = ratio("the true to the calibrated focal length", 0.9, 1.1)
    distortion_offset: float = quantity(
        "true minus calibrated first radial distortion coefficient", "", -0.2, 0.2, default=0.0
    )
    noise: float = quantity(
        "standard deviation of the pixel noise", "grey levels", 0.0, 20.0, default=2.0
    )
    light_falloff: float = quantity(
        "fraction of the light lost from the brightest to the darkest side",
        "",
        0.0,
        0.9,
        default=0.3,
    )
    exposure: float = quantity("exposure time", "s", 0.0001, 0.03, default=0.006)
    readout: float = quantity(
        "rolling shutter: time from the exposure of the first row to that of the last; "
        "0 for a global shutter",
        "s",
        0.0,
        0.05,
        default=0.0,
    )
    shows_arm: bool = text("whether the image shows the arm and the strikers", default=True)
    latency: float = quantity("delay from exposure to publication", "s", 0.0, 0.5, default=0.015)

    @property
    def imaging_time(self) -> float:
        """Time from the beginning of the first row's exposure to the end of the last row's, s."""
        return self.exposure + self.readout

    def check_rate(self, rate: float) -> None:
        """Refuse a frame rate, Hz, at which an image would begin before the one before it is
        complete. Raises ConfigurationError."""
        if self.imaging_time > 1.0 / rate:
            taken, keys = f"the exposure time is {1e3 * self.exposure:g} ms", "camera.exposure"
            if self.readout > 0.0:
                taken += f" and the read-out takes {1e3 * self.readout:g} ms"
                keys += " or camera.readout"
            raise ConfigurationError(
                f"{taken}, longer than the {1e3 / rate:.1f} ms between two images at {rate:g} Hz; "
                f"decrease the frame rate, or {keys} in the file with the simulation parameters"
            )


@dataclass(frozen=True, slots=True)
class TruthFile:
    """Parameters of the simulated world."""

    object_start: tuple[float, float, float] = quantity(
        "initial pose of the object: x and y in m, theta in rad", "", -7.0, 7.0
    )
    support: SupportTruth = section("support of the object", default=SupportTruth())
    surface: SurfaceTruth = section("friction of the table", default=SurfaceTruth())
    impact: ImpactTruth = section("impact", default=ImpactTruth())
    scatter: ScatterTruth = section("scatter of a tap", default=ScatterTruth())
    arm: ArmTruth = section("arm", default=ArmTruth())
    mounts: MountsTruth = section("mounts of fixed tappers", default=MountsTruth())
    camera: CameraTruth = section("camera", default=CameraTruth())
    further_starts: tuple[tuple[float, float, float], ...] = quantity(
        "initial poses of the cell's additional objects, in their order; objects without one "
        "start at random free places",
        "",
        -7.0,
        7.0,
        default=(),
    )
