"""The page of a commissioning session, with the measurements of each step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tapping_cell.report.rendering import render

PAGE = "commissioning.html"


def write_page(
    folder: Path,
    titles: Sequence[tuple[str, str]],
    proofs: Mapping[str, Any],
    *,
    hardware: bool,
) -> Path:
    """Write ``commissioning.html``; ``titles`` are name and title of every step, in order.
    ``hardware``: whether the steps ran on hardware."""
    text = render(
        "commissioning.html",
        steps=titles,
        proofs=proofs,
        cell="cell" if hardware else "simulated cell",
        done=sum(name in proofs for name, _ in titles),
        seconds=sum(float(proof["seconds"]) for proof in proofs.values()),
    )
    page = folder / PAGE
    page.write_text(text, encoding="utf-8")
    return page
