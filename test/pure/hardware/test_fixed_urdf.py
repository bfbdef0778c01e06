"""In the URDF of fixed tappers, the tips are where the cell file places them."""

from __future__ import annotations

import math
from xml.etree import ElementTree

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.hardware.fixed_urdf import mounted_tappers_urdf


def test_every_tapper_has_a_mount_and_a_striker_that_travels_along_its_line() -> None:
    cell = load_cell(shared_folder() / "positioning_cell" / "cell.yaml")
    robot = ElementTree.fromstring(mounted_tappers_urdf(cell.mounted_tappers()))
    links = [link.attrib["name"] for link in robot.iter("link")]
    joints = {joint.attrib["name"]: joint for joint in robot.iter("joint")}
    assert len(set(links)) == len(links) == 1 + 2 * 8
    assert len(joints) == 2 * 8
    children = [joint.find("child").attrib["link"] for joint in joints.values()]  # type: ignore[union-attr]
    assert sorted(children) == sorted(set(links) - {"table"})
    for entry in cell.fixed_tappers.tappers:
        origin = joints[f"{entry.name}_mount"].find("origin")
        assert origin is not None
        x, y, z = map(float, origin.attrib["xyz"].split())
        yaw = float(origin.attrib["rpy"].split()[2])
        assert (x, y) == entry.position and z == cell.strike_height
        assert math.isclose(yaw, entry.direction)
        slider = joints[entry.name]
        axis, limit = slider.find("axis"), slider.find("limit")
        assert axis is not None and axis.attrib["xyz"] == "1 0 0"
        assert limit is not None
        assert float(limit.attrib["upper"]) == cell.tapper_of(entry).stroke
        assert float(limit.attrib["lower"]) == 0.0
        # The mount's origin is the striker's resting tip, which is outside the circular working
        # area.
        area = cell.fixed_tappers.working_area
        assert math.hypot(x - area[0], y - area[1]) > area[2]
