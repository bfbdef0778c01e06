"""Output of the reference markers as a table file."""

from __future__ import annotations

from tapping_cell.configuration.provenance import Provenance, provenance_yaml
from tapping_cell.vision.markers.detection import ReferenceMap


def table_yaml(references: ReferenceMap, record: Provenance | None, comment: str) -> str:
    """Format the file: lengths in m to a tenth of a micrometre, angles in rad."""
    lines = [f"# {comment}", f"dictionary: {references.dictionary}", "markers:"]
    lines += [
        f"  - {{id: {m.id}, size: {m.size:.7g}, x: {m.x:.7f}, y: {m.y:.7f}, theta: {m.theta:.7f}}}"
        for m in references.markers
    ]
    return "\n".join(lines) + "\n" + (provenance_yaml(record) if record else "")
