"""Names and files of the images that verbs write, and checks that these replace no input image."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tapping_cell.calibration.keep import KeptFile


def distinct_names(paths: Iterable[Path]) -> dict[Path, str]:
    """Return a display name for each path: its file name, preceded by as many folders as are needed
    to distinguish files with the same file name. The result has the order of ``paths``."""
    different = list(dict.fromkeys(paths))
    groups: dict[str, list[Path]] = {}
    for path in different:
        groups.setdefault(path.name, []).append(path)
    names: dict[Path, str] = {}
    for same in groups.values():
        parts = [path.absolute().parts for path in same]
        depth = 1
        while len({entry[-depth:] for entry in parts}) < len(set(parts)):
            depth += 1
        names |= {path: str(Path(*entry[-depth:])) for path, entry in zip(same, parts, strict=True)}
    return {path: names[path] for path in different}


def picture_files(folder: Path, names: Sequence[str], reserved: Iterable[str] = ()) -> list[Path]:
    """Return a PNG file in ``folder`` for each name. A slash becomes an underscore, and a name that
    occurs twice or is ``reserved`` gets a number."""
    used = set(reserved)
    files = []
    for name in names:
        flat = name.replace(os.sep, "_")
        number, chosen = 1, flat
        while chosen in used:
            number += 1
            chosen = f"{flat}_{number}"
        used.add(chosen)
        files.append(folder / f"{chosen}.png")
    return files


def refuse_replacing(folder: Path, files: Iterable[Path], images: Iterable[Path]) -> None:
    """Check, before any work, that writing ``files`` into ``folder`` replaces no input image and
    that no annotated image is later taken for an input.

    Raises:
        KeptFile: ``folder`` is a file or contains an input image, or a file is an input image.
    """
    if folder.exists() and not folder.is_dir():
        raise KeptFile(f"--annotate {folder} is a file; give a folder")
    inputs = {image.resolve() for image in images}
    if folder.resolve() in {
        place.resolve() for image in images for place in (image.parent, image.resolve().parent)
    }:
        raise KeptFile(
            f"--annotate {folder} is the folder of the input images, which annotated copies could "
            "replace; give another folder"
        )
    for file in files:
        if file.resolve() in inputs:
            raise KeptFile(
                f"--annotate {folder}: the annotated copy {file} would replace the input image "
                f"{file.resolve()}; give another folder"
            )


def write_image(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write an image as PNG.

    Raises:
        OSError: the file cannot be written. The message names the file and the reason.
    """
    encoded, data = cv2.imencode(".png", picture)
    if not encoded:
        raise OSError(f"{path}: an image of shape {picture.shape} cannot be encoded as PNG")
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise OSError(
            f"{path} cannot be written ({error.strerror}); free space on the disk, or give a "
            "folder in which files can be written"
        ) from error
