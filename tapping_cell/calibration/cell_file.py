"""Update of one section of a cell file after a calibration; the rest of the file is unchanged."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from tapping_cell.calibration.yaml_edit import numbers_text, with_items, with_section, with_value
from tapping_cell.configuration.cell import Cell, load_cell, load_further_objects
from tapping_cell.configuration.provenance import Provenance


def calibrated_cell(
    cell: Cell,
    section: str,
    values: Mapping[str, float | Sequence[float]],
    record: Provenance,
    target: Path,
) -> str:
    """Return the text of the cell file with ``values`` and ``record`` in its ``section``.

    The paths of the table, camera, object and URDF files become relative to the folder of
    ``target``.

    Raises:
        ConfigurationError: the section is written as a flow mapping (in braces).
    """
    text = cell.path.read_text(encoding="utf-8")
    texts = {key: numbers_text(value) for key, value in values.items()}
    text = with_section(text, section, texts, record, str(cell.path))
    here, there = cell.path.parent.resolve(), target.parent.resolve()
    if here == there:
        return text

    def moved(path: str) -> str:
        return json.dumps(os.path.relpath(here / Path(path), there), ensure_ascii=False)

    file = cell.file
    for key in ("reference_markers", "camera_info", "object"):
        text = with_value(text, key, moved(getattr(file, key)))
    objects = [moved(str(Path(path).expanduser())) for path in file.objects]
    text = with_items(text, "objects", objects)
    own = None if file.arm is None else file.arm.ros2_control
    if own is not None and own.chain is not None:
        text = with_value(text, "arm.ros2_control.chain.urdf", moved(own.chain.urdf))
    return text


def load_cell_with_objects(
    path: Path | str | None = None, object_path: Path | str | None = None
) -> Cell:
    """Load a cell file like ``load_cell``, and check the files of its further objects, as the nodes
    do when they start.

    ``object_path`` replaces the object file that the cell file names.

    Raises:
        ConfigurationError: a file is invalid; the message names file, key, value and range.
    """
    cell = load_cell(path)
    load_further_objects(cell)
    return cell if object_path is None else load_cell(path, object_path)
