"""A link to a robot's own ROS driver is used again by the next driver of the device."""

from __future__ import annotations

from types import SimpleNamespace
from unittest.mock import Mock

from tapping_cell.nodes.drivers.driver_node import DriverNode


def test_a_stop_of_the_former_driver_does_not_block_the_next_one() -> None:
    """The state machine keeps the stop and makes the next driver stop again."""
    node, links = SimpleNamespace(_link=None, _linked_to=None), [Mock(), Mock()]
    make = Mock(side_effect=links)
    assert DriverNode.link_to(node, "section", make) is links[0]  # type: ignore[arg-type, type-var]
    links[0].release.reset_mock()
    assert DriverNode.link_to(node, "section", make) is links[0]  # type: ignore[arg-type, type-var]
    links[0].release.assert_called_once_with()
    assert DriverNode.link_to(node, "other", make) is links[1]  # type: ignore[arg-type, type-var]
    links[0].destroy.assert_called_once_with()
