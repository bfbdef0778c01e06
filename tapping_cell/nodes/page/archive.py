"""A run folder as one file to download."""

from __future__ import annotations

import os
import tempfile
import zipfile
from pathlib import Path


def make_archive(folder: Path) -> Path:
    """A ZIP file of a folder, below one folder of its name; the caller takes it away again.

    Links out of the folder are left out. Bags are packed already, and are only put in.

    Raises:
        OSError: the folder cannot be read, or there is no room for the file.
    """
    folder = folder.resolve(strict=True)
    handle, name = tempfile.mkstemp(prefix="tapping_cell-run-", suffix=".zip")
    archive = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream, zipfile.ZipFile(stream, "w") as packed:
            for file in sorted(folder.rglob("*")):
                if file.is_file() and file.resolve().is_relative_to(folder):
                    how = zipfile.ZIP_STORED if file.suffix == ".mcap" else zipfile.ZIP_DEFLATED
                    packed.write(file, Path(folder.name) / file.relative_to(folder), how)
    except BaseException:
        archive.unlink(missing_ok=True)
        raise
    return archive
