"""Lookup of a goal's frame in the buffer of tf2, with a buffer that a test replaces."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.time import Time as RosTime

from tapping_cell.logic.frames import FrameError
from tapping_cell.messages import Time
from tapping_cell.nodes.planner import tf_frames


class Unconnected(Exception):
    """Exception of tf2 for a frame that is not connected."""


class Buffer:
    """Buffer that knows frames whose names YAML reads as other types than text."""

    def __init__(self, **_: Any) -> None:
        pass

    def lookup_transform(self, target: str, source: str, at: RosTime) -> None:
        raise Unconnected(source)

    def all_frames_as_yaml(self) -> str:
        names = ("12", "0o17", "yes", "fixture")
        return "".join(f"{name}:\n  parent: 'table'\n  rate: 1.0\n" for name in names)

    def can_transform(self, target: str, source: str, at: RosTime) -> bool:
        assert isinstance(source, str)
        return True


@pytest.fixture
def frames(monkeypatch: pytest.MonkeyPatch) -> tf_frames.TfFrames:
    replaced = SimpleNamespace(
        Buffer=Buffer,
        TransformListener=lambda buffer, node: None,
        TransformException=Unconnected,
        ExtrapolationException=Unconnected,
    )
    monkeypatch.setattr(tf_frames, "tf2_ros", replaced)
    node: Any = None
    return tf_frames.TfFrames(node, "")


def test_frames_with_unusual_names_are_listed_as_they_are(frames: tf_frames.TfFrames) -> None:
    with pytest.raises(FrameError, match="use one of table, 0o17, 12, fixture, yes$"):
        frames.in_table("elsewhere", Time())


def test_a_stamp_that_ros_cannot_represent_is_refused(frames: tf_frames.TfFrames) -> None:
    with pytest.raises(FrameError, match="'fixture'"):
        frames.in_table("fixture", Time(sec=-5))
