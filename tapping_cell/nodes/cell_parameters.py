"""Parameters that several nodes have."""

from __future__ import annotations

from dataclasses import dataclass

from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.configuration.schema import text

FRAME_PREFIX = (
    "prefix of the names of the cell's frames, such as left/, for several cells with one /tf"
)
"""Description of the parameter ``frame_prefix``."""


@dataclass(frozen=True, slots=True)
class CellParameters:
    """Parameters of a node that reads the cell file."""

    autostart: bool = text("configure and activate automatically at start-up", default=True)
    cell_file: str = text("path of the cell file; if empty, the package's default", default="")
    frame_prefix: str = text(FRAME_PREFIX, default="")

    def load_cell(self) -> Cell:
        """Read the cell file with its object file. Raises ConfigurationError."""
        return load_cell(self.cell_file or None)


@dataclass(frozen=True, slots=True)
class ObjectParameters(CellParameters):
    """Parameters of a node that also reads an object file."""

    object_file: str = text(
        "path of the object file; if empty, the one named in the cell file", default=""
    )

    def load_cell(self) -> Cell:
        """Read the cell file and the object file. Raises ConfigurationError."""
        return load_cell(self.cell_file or None, self.object_file or None)
