"""The record of a calibration: the section ``calibration`` in the files that a calibration
writes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tapping_cell.configuration.schema import build, quantity, read_yaml, text
from tapping_cell.configuration.yaml_document import format_yaml


@dataclass(frozen=True, slots=True)
class Provenance:
    """Inputs, residual and uncertainty of a calibration.

    ``residual`` is the error that remains after the fit, and ``uncertainty`` is the standard
    deviation of the result. These two values are compared when a later calibration would replace
    the file (see calibration/keep.py).
    """

    by: str = text("verb that wrote the record, such as 'calibrate arm'")
    made: str = text("date and time, ISO 8601")
    inputs: tuple[str, ...] = text(
        "names of the input files, each with the first digits of its SHA-256 hash"
    )
    observations: int = quantity("number of observations used", "", 0, 1_000_000_000)
    left_out: int = quantity("number of observations rejected", "", 0, 1_000_000_000)
    residual: float = quantity("root mean square of the residuals", "", 0.0, 1e12)
    residual_of: str = text("quantity and unit of the residual")
    uncertainty: float = quantity("standard deviation of the result", "", 0.0, 1e12)
    uncertainty_of: str = text("quantity and unit of the uncertainty")
    deviations: Mapping[str, float] = quantity(
        "standard deviation of each calibrated value, by its name and in its unit in this file",
        "",
        0.0,
        1e12,
    )
    notes: tuple[str, ...] = text("remarks on the calibration", default=())


def provenance_yaml(record: Provenance, indent: int = 0) -> str:
    """Format the record as YAML text under the key ``calibration``, with every line indented."""
    content = {name: _plain(value) for name, value in asdict(record).items()}
    dumped = format_yaml({"calibration": content}, width=96 - indent)
    return "".join(" " * indent + line + "\n" for line in dumped.splitlines())


def _plain(value: Any) -> Any:
    """Round numbers to six digits and convert tuples to lists, for writing as YAML."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, Mapping):
        return {name: _plain(entry) for name, entry in value.items()}
    return list(value) if isinstance(value, tuple) else value


def read_provenance(path: Path, keys: tuple[str, ...] = ("calibration",)) -> Provenance | None:
    """Read the record at ``keys`` of a YAML file; None if the file has no record.

    Raises:
        ConfigurationError: the file cannot be read, or the record is invalid.
    """
    found = read_yaml(path)
    for key in keys:
        if not isinstance(found, Mapping) or key not in found:
            return None
        found = found[key]
    if found is None:
        return None
    return build(Provenance, found, str(path), ".".join(keys))
