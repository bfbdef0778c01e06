"""Recording of one goal: its folder, its bag, and the report page made from them."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rclpy.serialization import deserialize_message
from tapping_cell_msgs.msg import ArrangementState, GoalReport, PlanState

from tapping_cell.configuration.cell import Cell, cells_of
from tapping_cell.logic.planner_states import WORKING_STATES
from tapping_cell.nodes.computer import disk_space
from tapping_cell.nodes.recorder.retention import count_runs
from tapping_cell.planning.prescribed import METHOD as PRESCRIBED
from tapping_cell.report.message_files import UnknownMessageType
from tapping_cell.report.recorded import Bag, BagError, Quality, Recorded, Topic
from tapping_cell.report.run_folder import write_folder, write_illustrated_run
from tapping_cell.report.run_reader import illustrated_run
from tapping_cell.report.versions import versions

if TYPE_CHECKING:
    from tapping_cell.report.bag import BagWriter
    from tapping_cell.report.message_types import MessageTypes

BAG = "bag"
MEGABYTE = 1_000_000


class CannotRecord(RuntimeError):
    """The run cannot be recorded. The message states the reason and the remedy."""


@dataclass(frozen=True, slots=True)
class ReceivedMessage:
    """A received message: resolved topic name, ROS time of reception in ns, serialised CDR
    bytes."""

    topic: str
    stamp: int
    data: bytes


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """Type and settings of a topic in the bag."""

    kind: str
    quality: Quality


def new_folder(
    parent: Path, name: str, most_runs: int, least_free: float, prepared: bool = False
) -> Path:
    """Create a new folder for a run. ``least_free`` is in bytes.

    ``prepared``: if a folder of this name exists and contains no run yet, use this folder instead
    of a new folder. The verb demo creates such a folder in advance for the nodes' logs. If not
    ``prepared``, an existing folder belongs to another cell whose run started in the same second,
    so a number is appended to the name.

    Raises:
        CannotRecord: there are too many runs, the free disk space is too small, or the folder
            cannot be created.
    """
    try:
        parent.mkdir(parents=True, exist_ok=True)
        check_disk_space(parent, least_free)
        # Usually there are few folders, and none has to be opened.
        folders = sum(1 for entry in parent.iterdir() if entry.is_dir())
        if folders >= most_runs and (runs := count_runs(parent)) >= most_runs:
            raise CannotRecord(
                f"{parent} holds {runs} runs and most_runs is {most_runs}; nothing is "
                "deleted without keep_free: move old runs away, or raise most_runs"
            )
        for number in range(1, most_runs + 2):
            folder = parent / (name if number == 1 else f"{name}_{number}")
            if prepared and not (folder / BAG).exists() and not (folder / "summary.json").exists():
                folder.mkdir(exist_ok=True)
                return folder
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                return folder
    except OSError as error:
        raise CannotRecord(
            f"no run folder can be made in {parent} ({error.strerror}); set the parameter "
            "'folder' to a writable path"
        ) from error
    raise CannotRecord(
        f"every name from {name} to {name}_{most_runs + 1} is taken in {parent}; choose another "
        "name"
    )


def check_disk_space(folder: Path, least_free: float) -> None:
    """Check the free disk space.

    Raises:
        CannotRecord: the free space is too small.
        OSError: the disk is not available.
    """
    free = disk_space(folder)[0]
    if free < least_free:
        raise CannotRecord(
            f"the disk of {folder} has only {free / MEGABYTE:.0f} MB free, but "
            f"{least_free / MEGABYTE:.0f} MB are needed: move old runs to another disk, or reduce "
            "the parameter least_free"
        )


def run_name(began: float, namespace: str, goal: Any) -> str:
    """Return a run name with start time, namespace and goal (mm, mm, degrees)."""
    return _joined(began, namespace, _goal_words(goal.pose))


def arrangement_name(began: float, namespace: str, report: ArrangementState) -> str:
    """Return the run name of an arrangement. The name contains the goal if there is a single
    object, otherwise the number of objects."""
    goals = [one for one in report.objects if one.has_goal]
    if len(goals) == 1:
        words = f"{goals[0].object_id}_{_goal_words(goals[0].goal_pose)}"
    else:
        words = f"arrange_{len(goals)}_objects"
    return _joined(began, namespace, words)


def _goal_words(pose: Any) -> str:
    turn = 2 * math.degrees(math.atan2(pose.orientation.z, pose.orientation.w))
    values = (1000 * pose.position.x, 1000 * pose.position.y, (turn + 180) % 360 - 180)
    where = "_".join(f"{value:.0f}" if math.isfinite(value) else "nan" for value in values)
    return f"to_{where}"


def _joined(began: float, namespace: str, words: str) -> str:
    when = datetime.fromtimestamp(began).strftime("%Y-%m-%d_%H-%M-%S")
    parts = (when, namespace.strip("/").replace("/", "-"), words)
    return re.sub(r"[^\w.+-]", "_", "_".join(part for part in parts if part))[:120]


def cell_notes(cell: Cell | None, seed: int) -> dict[str, Any]:
    """Return the configuration of a run, to be stored in its bag. It contains the versions and the
    random seed. If ``cell`` is known, it also contains the objects, tolerance, table and contents
    of the configuration files."""
    notes: dict[str, Any] = {"versions": versions(), "seed": seed if seed >= 0 else None}
    if cell is not None:
        table, fixed = cell.file.table, cell.file.fixed_tappers
        folder = cell.path.parent
        files = {
            cell.path,
            cell.object_path,
            folder / cell.file.reference_markers,
            folder / cell.file.camera_info,
        }
        notes |= {
            "object": cell.object.name,
            "outline": cell.outline(),
            "objects": [
                {"name": name, "outline": each.outline()} for name, each in cells_of(cell).items()
            ],
            "tolerance": cell.tolerance,
            "table_size": (table.length, table.width),
            "mounts": [
                (each.name, *each.position, each.direction)
                for each in (fixed.tappers if fixed else ())
            ],
            "files": {str(f): f.read_text(encoding="utf-8") for f in sorted(files)},
        }
    return notes


class Recording:
    """Run folder with an open bag, or without rosbags, with the messages in memory. Every method is
    called from the recorder's own thread."""

    def __init__(
        self, folder: Path, topics: dict[str, RecordedTopic], types: MessageTypes | None
    ) -> None:
        """Open a bag for these topics, given by resolved name; ``types`` is None without rosbags.

        Raises:
            CannotRecord: the bag cannot be created.
        """
        self.folder = folder
        self._topics = {name: Topic(name, topic.kind) for name, topic in topics.items()}
        self._kept: list[Recorded] = []
        self._bag: BagWriter | None = None
        if types is None:
            return
        from tapping_cell.report.bag import BagWriter

        try:
            self._bag = BagWriter(folder / BAG, types, {"run": folder.name})
            for name, topic in topics.items():
                self._bag.add_topic(name, topic.kind, topic.quality)
        except (BagError, UnknownMessageType) as error:
            raise CannotRecord(str(error)) from error
        except OSError as error:
            raise CannotRecord(f"{folder} cannot be written ({error.strerror})") from error

    def write(self, messages: Iterable[ReceivedMessage]) -> None:
        """Write messages and flush them to the operating system.

        Raises:
            OSError: the disk is full or not available.
        """
        if self._bag is None:
            self._kept += [Recorded(self._topics[m.topic], m.stamp, m.data) for m in messages]
            return
        for message in messages:
            self._bag.write(message.topic, message.stamp, message.data)
        self._bag.flush()

    def close(self) -> None:
        """Close the bag.

        Raises:
            OSError: the disk is full or not available.
        """
        if self._bag is not None:
            self._bag.close()

    def write_report(self, pictures: bool) -> None:
        """Write the summary and the taps from the messages and, if ``pictures`` is set, the image
        and the page.

        Raises:
            BagError, OSError: the messages contain no run, or the files cannot be written.
        """
        if self._bag is not None:
            write_folder(self.folder, pictures=pictures)
            return
        bag = Bag(self.folder, tuple(self._kept), "", _decode)
        write_illustrated_run(self.folder, illustrated_run(bag, self.folder.name), pictures)


def _decode(data: bytes, kind: str) -> Any:
    """Return a message; raise ValueError if the bytes do not match its type."""
    package, _, name = kind.split("/")
    try:
        return deserialize_message(data, getattr(import_module(f"{package}.msg"), name))
    except RuntimeError as error:
        raise ValueError(str(error)) from error


def is_own_goal(plan: PlanState) -> bool:
    """Return whether a plan_state belongs to a goal that the recorder records. Single taps are not
    among these goals, because they have their own records."""
    busy = plan.state in WORKING_STATES
    return bool(busy and plan.goal.header.frame_id and plan.planner != PRESCRIBED)


def same_goal(plan: PlanState, other: PlanState | GoalReport) -> bool:
    """Return whether two reports refer to the same goal."""
    return bool(plan.goal == other.goal)
