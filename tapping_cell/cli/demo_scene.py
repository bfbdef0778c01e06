"""Several objects on the simulated table for the demo: object files, a cell file that names them,
a simulation parameter file with their poses, and a layout."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import Cell, load_cell, load_further_objects
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.layout_file import LayoutFile
from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.configuration.schema import ConfigurationError, load, read_yaml
from tapping_cell.configuration.yaml_document import format_yaml
from tapping_cell.durable_file import replace_text
from tapping_cell.planning import FreeSpace, make_planner
from tapping_cell.planning.evaluation.arrangements import Kind, draw_places, swapped_goals
from tapping_cell.se2 import Pose

FIRST_MARKER = 20
"""Marker id of the first generated object. The supplied table and objects use other ids."""
DISKS_M, SQUARES_M = (0.030, 0.026), (0.024, 0.028)
"""Radii of the disks, and half side lengths of the squares, m. The generated disks use these radii
in turn; the generated squares use these half side lengths in turn."""
DENSITY = 2700 * 0.012
"""Mass per area of 12 mm of aluminium, kg/m^2, as in the supplied objects."""
GAP_M = 0.04
"""Minimum gap between objects at their start poses, and at their goals."""
TRIES = 40
GOALS = ("random", "swap")
MAX_OBJECTS = 8


@dataclass(frozen=True, slots=True)
class DemoScene:
    """Cell file and simulation parameter file of a scene, and the requested layout."""

    cell: Path
    truth: Path
    layout: LayoutFile


def write_scene(
    folder: Path,
    count: int,
    seed: int,
    cell: Path | None,
    own: Path | None,
    truth: Path | None,
    goals: str = "random",
) -> DemoScene:
    """Write the files of a scene of ``count`` objects: the object of the cell file (or of the
    object file ``own``, if given) and generated disks and squares. The start poses are random poses
    at which the arm can tap the objects. ``goals`` is one of ``GOALS``: random poses, or objects
    that exchange places in pairs.

    Raises:
        ConfigurationError: a file cannot be used, or the objects do not fit on the table.
    """
    folder.mkdir(parents=True, exist_ok=True)
    source = (cell or shared_folder() / "cell.yaml").resolve()
    content = _mapping(source)
    for key in ("reference_markers", "camera_info", "object"):
        content[key] = str((source.parent / str(content[key])).resolve())
    if own is not None:
        content["object"] = str(own.resolve())
    content["objects"] = [_write_object(folder, number).name for number in range(1, count)]
    cell_path = folder / "cell.yaml"
    _write(cell_path, content)
    made = load_cell(cell_path)
    if made.file.arm is None:
        raise ConfigurationError(
            f"{source}: has fixed tappers, which cannot arrange several objects; give a cell "
            "with an arm"
        )
    files = (made.object, *load_further_objects(made))
    starts, ends = _drawn([_kind(made, file) for file in files], seed, source, goals)
    parameters = _mapping(truth or shared_folder() / "truth" / "default.yaml")
    parameters["object_start"] = _numbers(starts[0])
    parameters["further_starts"] = [_numbers(start) for start in starts[1:]]
    truth_path = folder / "truth.yaml"
    _write(truth_path, parameters)
    layout_path = folder / "layout.yaml"
    named = zip(files, ends, strict=True)
    _write(
        layout_path,
        {"goals": [{"object": file.name, "pose": _numbers(goal)} for file, goal in named]},
    )
    return DemoScene(cell_path, truth_path, load(LayoutFile, layout_path))


def _kind(cell: Cell, file: ObjectFile) -> Kind:
    own = replace(cell, object=file)
    settings = assembly.make_planner_settings(own, cell.tolerance)
    return Kind(FreeSpace(assembly.make_strike_space(own)), make_planner("exact", settings))


def _drawn(
    kinds: list[Kind], seed: int, source: Path, wanted: str
) -> tuple[list[Pose], list[Pose]]:
    """Return random start poses of the objects, and their goal poses."""
    rng = np.random.default_rng(seed)
    for _ in range(TRIES):
        starts = draw_places(kinds, GAP_M, rng)
        if starts is None:
            continue
        goals = draw_places(kinds, GAP_M, rng) if wanted == "random" else swapped_goals(starts, rng)
        if goals is not None and all(
            kind.free.contains(np.array(goal[:2])) for kind, goal in zip(kinds, goals, strict=True)
        ):
            return starts, goals
    raise ConfigurationError(
        f"{len(kinds)} objects with gaps of {1e3 * GAP_M:.0f} mm do not fit on the table of "
        f"{source}; use fewer objects"
    )


def _write_object(folder: Path, number: int) -> Path:
    """Write the file of disk or square ``number``, with its own size, name and marker. Return the
    path."""
    square = number % 2 == 1
    size = (SQUARES_M if square else DISKS_M)[(number // 2) % 2]
    shipped = "aluminium_square" if square else "aluminium_disk"
    content = _mapping(shared_folder() / "objects" / f"{shipped}.yaml")
    content["name"] = f"{'square' if square else 'disk'} {number + 1}"
    if square:
        corners = [(-size, -size), (size, -size), (size, size), (-size, size)]
        content["shape"] = {"kind": "polygon", "vertices": [list(corner) for corner in corners]}
        area, marker = 4 * size**2, 1.5 * size
    else:
        content["shape"] = {"kind": "disk", "radius": size}
        area, marker = math.pi * size**2, 1.2 * size
    content["mass"] = round(DENSITY * area, 4)
    content["marker"] = {
        "dictionary": content["marker"]["dictionary"],
        "id": FIRST_MARKER + number,
        "size": round(marker, 4),
    }
    content.pop("calibration", None)
    path = folder / f"{content['name'].replace(' ', '_')}.yaml"
    _write(path, content)
    return path


def _mapping(path: Path) -> dict[str, Any]:
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise ConfigurationError(f"{path}: must be a mapping of keys to values")
    return content


def _write(path: Path, content: dict[str, Any]) -> None:
    replace_text(path, format_yaml(content))


def _numbers(pose: Pose) -> list[float]:
    return [round(float(value), 5) for value in pose]
