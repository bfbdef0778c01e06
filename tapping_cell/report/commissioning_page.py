"""The page of a commissioning session, with the measurements of each step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from tapping_cell.report.page_style import document

PAGE = "commissioning.html"


def write_page(folder: Path, titles: Sequence[tuple[str, str]], proofs: Mapping[str, Any]) -> Path:
    """Write ``commissioning.html``; ``titles`` are name and title of every step, in order."""
    done = sum(name in proofs for name, _ in titles)
    whole = done == len(titles)
    seconds = sum(float(proof["seconds"]) for proof in proofs.values())
    state = "The cell is commissioned" if whole else f"{done} of {len(titles)} steps are done"
    rows = "".join(
        _row(number, name, title, proofs.get(name))
        for number, (name, title) in enumerate(titles, start=1)
    )
    body = (
        f'<header class="{"good" if whole else "bad"}"><h1>Commissioning</h1>'
        f"<p>{state}; {seconds / 60:.1f} min of work. The files are in <code>config/</code>.</p>"
        "</header><section><h2>Steps</h2><table><thead><tr><th>step</th><th>measurement</th>"
        "<th>values</th><th>s</th><th>when</th></tr></thead>"
        f"<tbody>{rows}</tbody></table></section>"
    )
    page = folder / PAGE
    page.write_text(document("Commissioning", body), encoding="utf-8")
    return page


def _row(number: int, name: str, title: str, proof: Mapping[str, Any] | None) -> str:
    if proof is None:
        waiting = "<td>not done yet</td><td></td><td></td><td></td>"
        return f"<tr><td>{number}. {escape(title)}</td>{waiting}</tr>"
    values = "<br>".join(
        f"{escape(key)}: {escape(_text(value))}" for key, value in proof["values"].items()
    )
    return (
        f'<tr id="{escape(name)}"><td>{number}. {escape(title)}</td>'
        f"<td>{escape(proof['sentence'])}</td><td>{values}</td><td>{proof['seconds']}</td>"
        f"<td>{escape(proof['made'])}</td></tr>"
    )


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
