"""HTML pages from the templates in the folder ``templates``.

The templates contain the structure, the fixed words, the style and the scripts of the pages. They
escape every value that is not marked ``safe``; only drawings and colours are marked ``safe``.
"""

from __future__ import annotations

from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from tapping_cell.report import error_codes, palette

TEMPLATES = Path(__file__).parent / "templates"


def unbroken(text: str) -> str:
    """Keep numbers and their units on one line."""
    return text.replace(" mm", "\u00a0mm").replace(" deg", "\u00a0deg")


_ENVIRONMENT = Environment(
    loader=FileSystemLoader(TEMPLATES),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_ENVIRONMENT.filters["unbroken"] = unbroken
_ENVIRONMENT.globals.update(error_codes=error_codes, palette=palette)


def render(template: str, **values: object) -> str:
    """Return a complete page, which loads no other files.

    ``template``: name of a file in ``templates``. ``values``: what the template shows.
    """
    return _ENVIRONMENT.get_template(template).render(values)
