"""Output of a fitted object as a file for ``config/objects``, with the record of the fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from tapping_cell.calibration.estimates import with_estimates
from tapping_cell.calibration.experiment import plain
from tapping_cell.calibration.keep import fingerprints, now
from tapping_cell.calibration.object_fit import ObjectFit
from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.configuration.provenance import Provenance, provenance_yaml
from tapping_cell.configuration.yaml_document import format_yaml

_SCALES = ("scale_b1", "scale_b2", "scale_b3")


def fitted_object(fit: ObjectFit, record: Provenance) -> ObjectFile:
    """Return the object with the fitted values; values that were not fitted are unchanged."""
    scale = fit.content.impact_scale
    if fit.impact is not None:
        one, two, three = (float(f"{fit.impact.values[name]:.6g}") for name in _SCALES)
        scale = (one, two, three)
    fitted = with_estimates(fit.content, fit.estimates)
    return replace(fitted, impact_scale=scale, calibration=record)


def fit_record(fit: ObjectFit, inputs: Sequence[Path]) -> Provenance:
    """Create the record of the fit. It contains the values that are compared with those of later
    fits."""
    off = fit.by_sliding.distance / fit.measured.distance - 1
    torque = fit.estimate("torque_factor")
    kept = [entry.name for entry in fit.estimates if not entry.fitted]
    intervals = "; ".join(
        f"{entry.name} {entry.low:.4g} to {entry.high:.4g}"
        for entry in fit.estimates
        if entry.fitted
    )
    return Provenance(
        by="object fit",
        made=now(),
        inputs=fingerprints(inputs),
        observations=len(fit.used),
        left_out=len(fit.left_out),
        residual=float(np.sqrt(np.mean(off**2))),
        residual_of="displacements calculated from the initial velocities, relative",
        uncertainty=torque.std / torque.value,
        uncertainty_of="torque factor, relative",
        deviations={
            entry.name: entry.std
            for entry in fit.estimates
            if entry.fitted and math.isfinite(entry.std)
        },
        notes=(
            f"95 % intervals: {intervals}",
            *((f"not fitted: {', '.join(kept)}",) if kept else ()),
        ),
    )


FITTED = "Fitted to single taps (tapping_cell object fit)."
"""Heading of files that the verb ``object fit`` writes."""


def object_yaml(content: ObjectFile, record: Provenance | None, heading: str = FITTED) -> str:
    """Format the object file."""
    keys = plain(asdict(replace(content, calibration=None)))
    text = format_yaml(keys, default_flow_style=None, allow_unicode=True)
    title = f"# {heading}\n# Lengths in m, masses in kg, angles in rad.\n"
    return title + text + (provenance_yaml(record) if record is not None else "")
