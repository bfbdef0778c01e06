"""Copy of a cell file and the files that it names, with the device names of a deployed cell."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path

from tapping_cell.calibration.yaml_edit import with_items, with_value
from tapping_cell.configuration.cell import Cell
from tapping_cell.configuration.schema import ConfigurationError


def copied_cell(cell: Cell, ports: Mapping[str, str]) -> dict[str, str]:
    """Return the texts of ``cell.yaml`` and of the files that it names, by path in their new
    folder. ``ports``: new name of each port.

    Raises:
        ConfigurationError: two files have the same name.
    """
    texts: dict[str, str] = {}
    sources: dict[str, Path] = {}

    def copied(path: str, folder: str = "") -> str:
        source = (cell.path.parent / Path(path).expanduser()).resolve()
        name = folder + source.name
        if sources.setdefault(name, source) != source:
            raise ConfigurationError(
                f"{cell.path}: {sources[name]} and {source} have the same name; rename one"
            )
        texts[name] = source.read_text(encoding="utf-8")
        return json.dumps(name, ensure_ascii=False)

    file = cell.file
    text = cell.path.read_text(encoding="utf-8")
    text = with_value(text, "reference_markers", copied(file.reference_markers))
    text = with_value(text, "camera_info", copied(file.camera_info))
    text = with_value(text, "object", copied(file.object, "objects/"))
    text = with_items(text, "objects", [copied(path, "objects/") for path in file.objects])
    own = None if file.arm is None else file.arm.ros2_control
    if own is not None and own.chain is not None:
        text = with_value(text, "arm.ros2_control.chain.urdf", copied(own.chain.urdf))
    for old, new in ports.items():
        text = re.sub(
            rf"(\bport: *)[\"']?{re.escape(old)}[\"']?(?=[\s,}}]|$)", rf"\g<1>{new}", text
        )
    return texts | {"cell.yaml": text}
