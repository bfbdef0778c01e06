"""Detection of contradictions among the files of a cell.

A finding is a message that names the file and the contradictory values.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tapping_cell.configuration.assembly import (
    make_fixed_space,
    make_planner_settings,
    make_strike_space,
)
from tapping_cell.configuration.cell import LONGEST_FLIGHT_S, Cell, load_further_objects
from tapping_cell.configuration.chain_reach import chain_reach
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.hardware.port_names import device_of, is_foreign, port_problem
from tapping_cell.mechanics import MechanicsError
from tapping_cell.planning import FreeSpace, PlanningError, make_planner, planner_names
from tapping_cell.planning.coverage import coverage
from tapping_cell.planning.free_space import WIDEST_GAP

MIN_TAPPABLE = 0.5
"""A warning is reported if the arm can tap objects in less than this fraction of the usable
area."""
FASTEST_ARM, STRONGEST_ARM = 20.0, 200.0
"""Maximum speed, m/s, and acceleration, m/s^2, of the end of an arm that turns about its shoulder:
twice those of fast arms. Larger values are probably in degrees."""
NOISE_MARGIN = 3.0
"""Number of standard deviations of the measured pose that should fit into the tolerance."""


def conflicts(cell: Cell) -> tuple[list[str], list[str]]:
    """Return a list of errors and a list of warnings. An error would make goals fail. A warning
    reports a risk: a goal may fail, the quill may sink, or a port does not exist yet."""
    if cell.file.fixed_tappers is not None:
        errors = [*_markers(cell), *_fixed_tappers(cell), *_further_objects(cell)]
        errors += port_errors(cell)
        return errors, [*_noise(cell), *_missing_ports(cell), *_channels(cell)]
    errors = [*_markers(cell), *_heights(cell), *_joints(cell), *_curve(cell), *_planner(cell)]
    errors += [*_too_fast(cell), *_further_objects(cell), *port_errors(cell)]
    warnings = [*_noise(cell), *_missing_ports(cell), *_brake(cell), *_placing(cell)]
    warnings += _exchanged(cell)
    reach_errors, reach_warnings = _reach(cell)
    return errors + reach_errors, [*warnings, *reach_warnings, *chain_reach(cell)]


def _markers(cell: Cell) -> Iterator[str]:
    marker, references = cell.object.marker, cell.references
    if marker is None:
        return
    if marker.dictionary == references.dictionary:
        taken = [entry.id for entry in references.markers]
        if marker.id in taken:
            yield (
                f"{cell.object_path}: key 'marker.id' is {marker.id}, which is a reference marker "
                f"of the table too ({min(taken)} to {max(taken)}); give the object another id"
            )


def _further_objects(cell: Cell) -> Iterator[str]:
    """Check the objects of the key ``objects``: files, names, markers and heights."""
    try:
        files = load_further_objects(cell)
    except ConfigurationError as error:
        yield str(error)
        return
    for file in files:
        # Apply the marker checks of the cell's main object to each further object.
        yield from (
            f"'{file.name}': {sentence}" for sentence in _markers(replace(cell, object=file))
        )
        if cell.file.arm is not None and cell.file.arm.strike_height >= file.height:
            yield (
                f"{cell.path}: key 'arm.strike_height' is {1e3 * cell.file.arm.strike_height:.1f} "
                f"mm, but the further object '{file.name}' is {1e3 * file.height:.1f} mm high: the "
                "striker passes over the object; reduce this value"
            )


def _heights(cell: Cell) -> Iterator[str]:
    arm, tapper, path = cell.arm, cell.file.tapper, cell.path
    if arm.strike_height >= cell.object.height:
        yield (
            f"{path}: key 'arm.strike_height' is {1e3 * arm.strike_height:.1f} mm, but the object "
            f"is {1e3 * cell.object.height:.1f} mm high: the striker passes over the object; "
            "reduce this value"
        )
    if arm.strike_height < tapper.tip_radius:
        yield (
            f"{path}: key 'arm.strike_height' is {1e3 * arm.strike_height:.1f} mm, below the tip's "
            f"radius of {1e3 * tapper.tip_radius:.1f} mm: the tip scrapes the table; "
            "increase this value, or halve 'tapper.tip_radius' if it is the tip's diameter"
        )
    if arm.travel_height <= max(arm.strike_height, cell.object.height):
        yield (
            f"{path}: key 'arm.travel_height' is {1e3 * arm.travel_height:.1f} mm; it must be "
            f"above the object's height ({1e3 * cell.object.height:.1f} mm) and above "
            f"'arm.strike_height' ({1e3 * arm.strike_height:.1f} mm); increase it"
        )
    if arm.chain() is None:
        highest = arm.tip_height + arm.upper[2] + min(0.0, arm.joint_offset[2])
        if arm.travel_height > highest + 1e-9:
            yield (
                f"{path}: key 'arm.travel_height' is {1e3 * arm.travel_height:.1f} mm, but the "
                f"quill lifts the tip to at most {1e3 * highest:.1f} mm ('arm.tip_height' plus "
                "'arm.upper[2]'); reduce this value"
            )
        lowest = arm.tip_height + arm.lower[2] + max(0.0, arm.joint_offset[2])
        if arm.strike_height < lowest - 1e-9:
            yield (
                f"{path}: key 'arm.strike_height' is {1e3 * arm.strike_height:.1f} mm, but the "
                f"quill lowers the tip to {1e3 * lowest:.1f} mm at the lowest ('arm.tip_height' "
                "plus 'arm.lower[2]'); correct one of these keys"
            )
    if tapper.stroke <= tapper.standoff:
        yield (
            f"{path}: key 'tapper.stroke' is {1e3 * tapper.stroke:.1f} mm, not more than "
            f"'tapper.standoff' ({1e3 * tapper.standoff:.1f} mm): the striker never reaches the "
            "object; reduce the standoff or lengthen the stroke"
        )
    slowest = min(tapper.speeds)
    if tapper.stroke > LONGEST_FLIGHT_S * slowest:
        yield (
            f"{path}: at the slowest of 'tapper.speeds' ({1e3 * slowest:.1f} mm/s) the striker "
            f"takes {tapper.stroke / slowest:.1f} s for 'tapper.stroke', but the arm stands still "
            f"for at most {LONGEST_FLIGHT_S:g} s; remove the slowest speeds"
        )


def _joints(cell: Cell) -> Iterator[str]:
    arm = cell.arm
    for name, joints in (("park", arm.park), ("home", arm.home)):
        for index, (low, value, high) in enumerate(zip(arm.lower, joints, arm.upper, strict=True)):
            if not low <= value <= high:
                yield (
                    f"{cell.path}: key 'arm.{name}[{index}]' is {value:g}, outside the joint's "
                    f"limits {low:g} to {high:g} ('arm.lower', 'arm.upper'); correct one of them"
                )


def _too_fast(cell: Cell) -> Iterator[str]:
    """Compare speed and acceleration of the stretched arm about its shoulder with those of arms."""
    arm = cell.arm
    reach = arm.upper_arm + arm.forearm
    own = arm.ros2_control
    chain = own.chain.max_acceleration[:1] if own and own.chain else ()
    for key, values, limit, unit in (
        ("arm.max_speed", arm.max_speed[:1], FASTEST_ARM, "/s"),
        ("arm.max_acceleration", arm.max_acceleration[:1], STRONGEST_ARM, "/s^2"),
        ("arm.ros2_control.chain.max_acceleration", chain, STRONGEST_ARM, "/s^2"),
    ):
        for value in values:
            if value * reach > limit:
                yield (
                    f"{cell.path}: key '{key}[0]' is {value:g} rad{unit}, which would move the "
                    f"end of the stretched arm with {value * reach:.0f} m{unit} (limit {limit:g}); "
                    f"if the values are in deg{unit}, write {math.radians(value):.4g} here"
                )


def _exchanged(cell: Cell) -> Iterator[str]:
    """Find pairs of speeds and accelerations that make sense only after they are exchanged."""
    arm = cell.arm
    speeds, accelerations = np.array(arm.max_speed), np.array(arm.max_acceleration)
    travel = np.array(arm.upper) - np.array(arm.lower)
    # A joint that accelerates over half its travel reaches the speed sqrt(acceleration x travel).
    if np.sum(speeds**2 > accelerations * travel) > 1 and np.all(
        accelerations**2 <= speeds * travel
    ):
        yield (
            f"{cell.path}: with 'arm.max_acceleration', joints never reach 'arm.max_speed' within "
            "their limits; these two keys seem to be exchanged"
        )
    if arm.near_speed > arm.travel_speed:
        yield (
            f"{cell.path}: 'arm.near_speed' ({arm.near_speed:g}), for the slow moves, is more than "
            f"'arm.travel_speed' ({arm.travel_speed:g}); these two keys seem to be exchanged"
        )


def _placing(cell: Cell) -> Iterator[str]:
    """Look for a usual place of the table's markers and of the arm's base."""
    table = cell.file.table
    inside = [
        str(marker.id)
        for marker in cell.references.markers
        if abs(marker.x) < table.length / 2 and abs(marker.y) < table.width / 2
    ]
    if inside:
        yield (
            f"{cell.path}: the reference markers {', '.join(inside)} lie in the usable area of "
            f"{1e3 * table.length:.0f} mm along x and {1e3 * table.width:.0f} mm along y, where "
            "objects can cover them; check that 'table.length' and 'table.width' are not exchanged"
        )
    base = cell.arm_base
    towards = math.atan2(-base.y, -base.x)
    if math.cos(towards - base.theta) < 0.0:
        yield (
            f"{cell.path}: key 'arm.base[2]' is {base.theta:.4g} rad, with which the arm in its "
            "zero position points away from the middle of the table (towards it: "
            f"{towards:.4g}); check its sign"
        )


def _channels(cell: Cell) -> Iterator[str]:
    for board in cell.boards:
        used = sorted(board.channels.values())
        if len(used) > 1 and used == list(range(1, len(used) + 1)):
            yield (
                f"{cell.path}: the tappers of {board.port} have the channels 1 to {used[-1]}, "
                "but boards number their channels from 0; if you have counted from 1, subtract 1 "
                "from each 'channel'"
            )


def _curve(cell: Cell) -> Iterator[str]:
    """Compare the speeds of the tapper with the smallest tap of the object."""
    curve = cell.file.tapper.curve()
    smallest = cell.object.smallest_tap
    try:
        needed = float(
            make_strike_space(cell).tap.plan(np.array([smallest, 0.0, 0.0])).striker_speed
        )
    except (MechanicsError, PlanningError) as error:
        yield f"{cell.object_path}: no tap of {1e3 * smallest:.1f} mm can be planned: {error}"
        return
    if needed < curve.slowest:
        yield (
            f"{cell.path}: the slowest speed of 'tapper.speeds' is {1e3 * curve.slowest:.0f} "
            f"mm/s, but the object's smallest tap of {1e3 * smallest:.1f} mm ('smallest_tap') "
            f"needs {1e3 * needed:.0f} mm/s; calibrate the tapper at lower speeds, or raise "
            "smallest_tap"
        )
    if needed > curve.fastest:
        yield (
            f"{cell.path}: the fastest speed of 'tapper.speeds' is {1e3 * curve.fastest:.0f} mm/s, "
            f"but even the smallest tap of {1e3 * smallest:.1f} mm needs {1e3 * needed:.0f} mm/s; "
            "calibrate the tapper at higher speeds, or use a stronger or heavier striker"
        )


def _planner(cell: Cell) -> Iterator[str]:
    name = cell.file.goal.planner
    if name not in planner_names():
        yield (
            f"{cell.path}: key 'goal.planner' is '{name}', but must be one of "
            + ", ".join(planner_names())
        )
        return
    try:
        make_planner(name, make_planner_settings(cell, cell.tolerance))
    except PlanningError as error:
        yield f"{cell.path}: the planner '{name}' cannot work with these files: {error}"


def _reach(cell: Cell) -> tuple[list[str], list[str]]:
    """Check in what fraction of the usable area the arm can tap objects, using the planner's map of
    the free space."""
    space = make_strike_space(cell)
    free = FreeSpace(space)
    fits = space.workspace.object_clearance(free.centres) >= space.object_radius
    if not fits.any():
        return [
            f"{cell.path}: the object of {1e3 * space.object_radius:.0f} mm radius fits nowhere on "
            f"the table of {1e3 * space.workspace.length:.0f} x {1e3 * space.workspace.width:.0f} "
            "mm with its margins and keep-out zones; enlarge the table area, or reduce "
            "margins or zones"
        ], []
    share = float(np.count_nonzero(free.tappable)) / float(np.count_nonzero(fits))
    if share == 0.0:
        return [
            f"{cell.path}: the arm can tap the object nowhere on the table: at every "
            "place, no tap is possible over a range of directions of more than "
            f"{math.degrees(WIDEST_GAP):.0f} degrees; check 'arm.base', the links and the joint "
            "limits"
        ], []
    if share < MIN_TAPPABLE:
        return [], [
            f"{cell.path}: only {100 * share:.0f} % of the places where the object fits are "
            "within the arm's reach for taps; goals elsewhere are refused"
        ]
    return [], []


def _fixed_tappers(cell: Cell) -> Iterator[str]:
    """Yield every error that would make a goal in the working area fail."""
    fixed, path = cell.fixed_tappers, cell.path
    height, top = fixed.strike_height, cell.object.height
    if height >= top:
        yield (
            f"{path}: key 'fixed_tappers.strike_height' is {1e3 * height:.1f} mm, but the object "
            f"is {1e3 * top:.1f} mm high: the strikers pass over the object; reduce "
            "this value"
        )
    sections = cell.tapper_sections
    for name, tapper in sections.items():
        if height < tapper.tip_radius:
            yield (
                f"{path}: key 'fixed_tappers.strike_height' is {1e3 * height:.1f} mm, below the "
                f"tip radius of '{name}' ({1e3 * tapper.tip_radius:.1f} mm): the tip scrapes the "
                "table; increase this value"
            )
    wired: dict[tuple[str, int], str] = {}
    for entry in fixed.tappers:
        place = sections[entry.name].port, entry.channel
        if place in wired:
            yield (
                f"{path}: the tappers '{wired[place]}' and '{entry.name}' are both channel "
                f"{entry.channel} of {place[0]}; assign a different channel to each"
            )
        wired.setdefault(place, entry.name)
    space = make_fixed_space(cell)
    x, y, radius = fixed.working_area
    needed = space.object_radius
    for entry in fixed.tappers:
        distance = math.hypot(entry.position[0] - x, entry.position[1] - y)
        limit = radius + needed + sections[entry.name].tip_radius
        if distance < limit:
            yield (
                f"{path}: the tip of '{entry.name}' at rest is {1e3 * distance:.1f} mm from the "
                f"middle of the working area; an object at the edge of the area would touch the "
                f"tip; increase the distance to at least {1e3 * limit:.1f} mm"
            )
    if radius + needed > float(space.workspace.edge_distance(np.array([x, y]))):
        yield (
            f"{path}: an object at the edge of 'fixed_tappers.working_area' would hang over the "
            "table's edge; make the area smaller or move it"
        )
    for entry in fixed.tappers:
        away = x - entry.position[0], y - entry.position[1]
        cos, sin = math.cos(entry.direction), math.sin(entry.direction)
        across, along = cos * away[1] - sin * away[0], cos * away[0] + sin * away[1]
        if along < 0.0 or abs(across) > radius:
            yield (
                f"{path}: the line of travel of '{entry.name}' does not meet the working area: it "
                f"passes the middle at {1e3 * abs(across):.1f} mm (limit: its radius "
                f"{1e3 * radius:.1f} mm){' behind the tip' if along < 0.0 else ''}; correct "
                f"'direction' ({entry.direction:.4f} rad; towards the middle it would be "
                f"{math.atan2(away[1], away[0]):.4f}) or 'position'"
            )
            return
    cover = coverage(space)
    if np.any(cover.dead):
        share = 100.0 * float(np.mean(cover.dead))
        place = 1e3 * cover.points[int(np.argmax(cover.dead))]
        yield (
            f"{path}: from {share:.1f} % of the working area no tap moves the object inward (for "
            f"example from ({place[0]:.0f} mm, {place[1]:.0f} mm)); add tappers, place "
            "their lines closer to the middle, lengthen their strokes, or make "
            "fixed_tappers.working_area smaller; check-config --drawing FILE draws these places"
        )


def _noise(cell: Cell) -> Iterator[str]:
    noise, (distance, angle) = cell.file.camera, cell.tolerance
    for name, spread, limit, unit, factor in (
        ("position", noise.position_noise, distance, "mm", 1e3),
        ("angle", noise.angle_noise, angle, "deg", math.degrees(1.0)),
    ):
        if NOISE_MARGIN * spread > limit:
            yield (
                f"{cell.path}: key 'goal.{name}_tolerance' is {factor * limit:.3g} {unit}, "
                f"less than {NOISE_MARGIN:g} standard deviations of a measurement "
                f"('camera.{name}_noise', {factor * spread:.3g} {unit}): the cell may "
                "never measure a goal as reached; check the units (m, rad), increase the "
                "tolerance, or measure more accurately (a nearer or better camera, a larger marker)"
            )


def _brake(cell: Cell) -> Iterator[str]:
    if not cell.arm.quill_brake:
        yield (
            f"{cell.path}: key 'arm.quill_brake' is false: whenever the quill's motor loses its "
            "power (emergency stop, alarm, M112) the quill sinks onto the table or the object "
            "below it; fit "
            "a brake or a counterweight and set the key to true"
        )


def _ports_by_name(cell: Cell) -> dict[str, list[str]]:
    """Return the parts of the cell at each port. Tappers of one board have the same port."""
    parts: dict[str, list[str]] = {}
    for name, tapper in cell.tapper_sections.items():
        parts.setdefault(tapper.port, []).append(name)
    if cell.file.arm is not None:
        parts.setdefault(cell.file.arm.port, []).append("arm")
    parts.pop("", None)
    return parts


def port_errors(cell: Cell) -> list[str]:
    """Return the errors in the names of the ports: names of Windows, and one device for two parts
    of the cell, also if different links name it."""
    found = []
    devices: dict[str, tuple[str, list[str]]] = {}
    for port, names in _ports_by_name(cell).items():
        if is_foreign(port):
            found.append(f"{cell.path}: the port {port} of {', '.join(names)} {port_problem(port)}")
            continue
        if "arm" in names and len(names) > 1:
            found.append(
                f"{cell.path}: {' and '.join(sorted(names))} have the same port {port}; give each "
                "its own"
            )
        other, its = devices.setdefault(device_of(port), (port, names))
        if other != port:
            found.append(
                f"{cell.path}: the port {other} of {', '.join(its)} and the port {port} of "
                f"{', '.join(names)} are the same device {device_of(port)}; give each its own, or "
                "the tappers of one board the same name"
            )
    return found


def _missing_ports(cell: Cell) -> Iterator[str]:
    for port, names in _ports_by_name(cell).items():
        if not is_foreign(port) and (problem := port_problem(port)):
            yield f"{cell.path}: the port {port} of {', '.join(names)} {problem}"
