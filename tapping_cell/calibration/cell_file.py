"""Update of one section of a cell file after a calibration; the rest of the file is unchanged."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from tapping_cell.calibration.yaml_edit import numbers_text, with_section, with_value
from tapping_cell.configuration.cell import Cell
from tapping_cell.configuration.provenance import Provenance


def calibrated_cell(
    cell: Cell,
    section: str,
    values: Mapping[str, float | Sequence[float]],
    record: Provenance,
    target: Path,
) -> str:
    """Return the text of the cell file with ``values`` and ``record`` in its ``section``.

    The paths of the table, camera and object files become relative to the folder of ``target``.

    Raises:
        ConfigurationError: the section is written as a flow mapping (in braces).
    """
    text = cell.path.read_text(encoding="utf-8")
    texts = {key: numbers_text(value) for key, value in values.items()}
    text = with_section(text, section, texts, record, str(cell.path))
    here, there = cell.path.parent.resolve(), target.parent.resolve()
    if here != there:
        for key in ("reference_markers", "camera_info", "object"):
            path = os.path.relpath(here / getattr(cell.file, key), there)
            text = with_value(text, key, json.dumps(path))
    return text
