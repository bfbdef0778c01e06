"""One goal being recorded: its folder, its bag, and the page that is made of them."""

from __future__ import annotations

import contextlib
import math
import re
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from tapping_cell_msgs.msg import GoalReport, PlanState

from tapping_cell.configuration.cell import Cell
from tapping_cell.logic.planner import WORKING_STATES
from tapping_cell.report.bag import BagError, BagWriter, Quality
from tapping_cell.report.message_types import MessageTypes, UnknownMessageType
from tapping_cell.report.run_folder import write_folder
from tapping_cell.report.versions import versions

BAG = "bag"
MEGABYTE = 1_000_000


class CannotRecord(RuntimeError):
    """The run cannot be recorded; the sentence says why and what to do."""


@dataclass(frozen=True, slots=True)
class Heard:
    """One message as it came: its topic as resolved, ROS time in ns, its CDR bytes."""

    topic: str
    stamp: int
    data: bytes


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """How a topic stands in the bag."""

    kind: str
    quality: Quality


def new_folder(
    parent: Path, name: str, most_runs: int, least_free: float, prepared: bool = False
) -> Path:
    """Make the folder of a run that does not exist yet; ``least_free`` in bytes.

    ``prepared``: a folder of this name that holds no run yet was made for this one, as the verb
    demo does for the nodes' logs; else it is that of a cell that began a run in the same second.

    Raises:
        CannotRecord: too many runs, too little room, or the folder cannot be made.
    """
    try:
        parent.mkdir(parents=True, exist_ok=True)
        check_room(parent, least_free)
        runs = sum(1 for entry in parent.iterdir() if entry.is_dir())
        if runs >= most_runs:
            raise CannotRecord(
                f"{parent} holds {runs} folders and most_runs is {most_runs}; nothing is deleted "
                "by itself: move old runs away, or raise most_runs"
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
            f"no run folder can be made in {parent} ({error.strerror}); set the parameter folder "
            "to one that can be written"
        ) from error
    raise CannotRecord(f"every name like {name} in {parent} is taken; choose another name")


def check_room(folder: Path, least_free: float) -> None:
    """See that the disk has room.

    Raises:
        CannotRecord: it has not.
        OSError: the disk is away.
    """
    free = shutil.disk_usage(folder).free
    if free < least_free:
        raise CannotRecord(
            f"the disk of {folder} has {free / MEGABYTE:.0f} MB free and least_free is "
            f"{least_free / MEGABYTE:.0f} MB; make room: move old runs away"
        )


def run_name(began: float, namespace: str, goal: Any) -> str:
    """A name that tells when, in which namespace and where to (mm, mm, degrees)."""
    when = datetime.fromtimestamp(began).strftime("%Y-%m-%d_%H-%M-%S")
    pose = goal.pose
    turn = 2 * math.degrees(math.atan2(pose.orientation.z, pose.orientation.w))
    values = (1000 * pose.position.x, 1000 * pose.position.y, (turn + 180) % 360 - 180)
    where = "_".join(f"{value:.0f}" if math.isfinite(value) else "nan" for value in values)
    parts = (when, namespace.strip("/").replace("/", "-"), f"to_{where}")
    return re.sub(r"[^\w.+-]", "_", "_".join(part for part in parts if part))[:120]


def cell_notes(cell: Cell | None, seed: int) -> dict[str, Any]:
    """What a run knows of its configuration."""
    notes: dict[str, Any] = {"versions": versions(), "seed": seed if seed >= 0 else None}
    if cell is not None:
        table = cell.file.table
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
            "table_size": (table.length, table.width),
            "files": {str(f): f.read_text(encoding="utf-8") for f in sorted(files)},
        }
    return notes


class Recording:
    """A run's folder with its bag open; every method is called from the recorder's own thread."""

    def __init__(self, folder: Path, topics: dict[str, RecordedTopic], types: MessageTypes) -> None:
        """Begin a bag of these topics, by resolved name.

        Raises:
            CannotRecord: the bag cannot be made.
        """
        self.folder = folder
        try:
            self._bag = BagWriter(folder / BAG, types, {"run": folder.name})
            for name, topic in topics.items():
                self._bag.add_topic(name, topic.kind, topic.quality)
        except (BagError, UnknownMessageType) as error:
            raise CannotRecord(str(error)) from error
        except OSError as error:
            raise CannotRecord(f"{folder} cannot be written ({error.strerror})") from error

    def write(self, messages: Iterable[Heard]) -> None:
        """Write messages and hand them to the operating system.

        Raises:
            OSError: the disk is full or away.
        """
        for message in messages:
            self._bag.write(message.topic, message.stamp, message.data)
        self._bag.flush()

    def close(self) -> None:
        """Close the bag.

        Raises:
            OSError: the disk is full or away.
        """
        self._bag.close()

    def tell(self, pictures: bool) -> None:
        """Write summary, taps and, where there is time, picture and page, out of the bag.

        Raises:
            BagError, OSError: there is nothing to tell, or it cannot be written.
        """
        write_folder(self.folder, pictures=pictures)


def is_own_goal(plan: PlanState, method_of_experiments: str) -> bool:
    """Whether a plan_state speaks of a goal that is to be recorded; single taps keep records."""
    busy = plan.state in WORKING_STATES
    return bool(busy and plan.goal.header.frame_id and plan.planner != method_of_experiments)


def same_goal(plan: PlanState, other: PlanState | GoalReport) -> bool:
    """Whether two reports speak of the same goal."""
    return bool(plan.goal == other.goal)
