"""Build the documentation site: the pages of docs/ and the API from the docstrings.

    python environment/build_site.py        writes build/site/index.html; any warning is an error

The first run installs Sphinx and its theme in a folder next to .venv. Later runs need no network.
"""

from __future__ import annotations

import os
import pkgutil
import shutil
import subprocess
import sys
from pathlib import Path

import overlay

import tapping_cell

ROOT = Path(__file__).resolve().parent.parent
VERSIONS = ROOT / "environment" / "documents.txt"
LIBRARIES = ROOT / "build" / "site_libraries"
SOURCE = ROOT / "build" / "site_source"
SITE = ROOT / "build" / "site"
PAGES = (
    "README.md",
    "ARCHITECTURE.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "SECURITY.md",
    "QUALITY_DECLARATION.md",
)
"""Pages outside docs/ that belong to the site."""
# Sphinx options that differ from the defaults.
CONFIGURATION = """\
import sys

from pygments.lexers.special import TextLexer
from sphinx.highlighting import lexers

sys.path.insert(0, {here!r})
from site_docstrings import lists_and_commands

lexers["mermaid"] = TextLexer()  # diagrams are shown as text, because drawing them needs a network
project = "tapping_cell"
author = copyright = "the tapping_cell developers"
extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_parser"]
html_theme = "furo"
html_title = "Tapping cell"
root_doc = "index"
exclude_patterns = ["docs/images/**"]
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_use_ivar = True
napoleon_use_rtype = False
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]
autodoc_mock_imports = ["launch", "launch_ros"]
# Links from the pages to files of the repository are checked by a test of the documents. For a
# name that several modules define, the link leads to one of them.
suppress_warnings = ["myst.xref_missing", "myst.header", "ref.python"]


def setup(app):
    app.connect("autodoc-process-docstring", lists_and_commands)
"""


def write_source() -> None:
    """Copy the pages and write one page for each module."""
    shutil.rmtree(SOURCE, ignore_errors=True)
    shutil.copytree(ROOT / "docs", SOURCE / "docs")
    for page in PAGES:
        shutil.copy(ROOT / page, SOURCE / page)
    here = str(Path(__file__).resolve().parent)
    text = CONFIGURATION.replace("{here!r}", repr(here))
    (SOURCE / "conf.py").write_text(text, encoding="utf-8")
    api = SOURCE / "api"
    api.mkdir()
    below: dict[str, list[str]] = {"tapping_cell": []}
    packages = {"tapping_cell"}
    for module in pkgutil.walk_packages(tapping_cell.__path__, "tapping_cell."):
        if module.name.endswith("__main__"):
            continue
        below.setdefault(module.name, [])
        below[module.name.rpartition(".")[0]].append(module.name)
        if module.ispkg:
            packages.add(module.name)
    for name, modules in below.items():
        lines = [name, "=" * len(name), "", f".. automodule:: {name}", ""]
        if modules:
            lines += [".. toctree::", "   :maxdepth: 1", ""]
            lines += [f"   {module}" for module in modules]
        if name in packages:
            # Objects that a package exports are documented in the module that defines them.
            lines.insert(4, "   :no-members:")
        (api / f"{name}.rst").write_text("\n".join(lines) + "\n", encoding="utf-8")
    documents = sorted(
        path.relative_to(SOURCE).with_suffix("").as_posix()
        for path in (SOURCE / "docs").rglob("*.md")
        if "images" not in path.parts
    )
    contents = ["README", *documents, *(page[:-3] for page in PAGES[1:]), "api/tapping_cell"]
    index = ["Tapping cell", "============", "", ".. toctree::", "   :maxdepth: 1", ""]
    index += [f"   {name}" for name in contents]
    (SOURCE / "index.rst").write_text("\n".join(index) + "\n", encoding="utf-8")


def main() -> int:
    """Build the site and return the exit code."""
    overlay.install(VERSIONS, LIBRARIES)
    write_source()
    call = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going"]
    call += ["-d", str(ROOT / "build" / "site_cache"), "-b", "html", str(SOURCE), str(SITE)]
    status = subprocess.run(call, env={**os.environ, "PYTHONPATH": overlay.path(LIBRARIES)})
    if status.returncode == 0:
        print(f"the site is {SITE / 'index.html'}")
    return status.returncode


if __name__ == "__main__":
    sys.exit(main())
