"""One rule for every calibrated file: nothing is overwritten silently, a better one never by force
alone.

1. No file there: it is written.
2. A file is there: refused, unless ``force``.
3. With ``force``, the old file's record of the same verb is compared: if the old residual or the
   old uncertainty is smaller than the new one, refused, unless ``accept_worse`` as well. A file
   without such a record (written by hand) cannot be compared and gives way to ``force``.

The new text is read back by the reader that the nodes use before it takes the old one's place; what
that reader refuses is never written.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from tapping_cell.configuration.provenance import Provenance, read_provenance
from tapping_cell.configuration.schema import ConfigurationError

_SLACK = 1.01
"""A hundredth more is no worse: files hold six digits, and fits end a little apart."""


class KeptFile(ValueError):
    """The file that is there stays; the message says why and which option would change that."""


@dataclass(frozen=True, slots=True)
class Output:
    """Where a calibration goes, and what the person allows."""

    path: Path
    force: bool = False
    accept_worse: bool = False
    record_at: tuple[str, ...] = ("calibration",)
    """Keys of the file's section with its :class:`Provenance`."""


def refuse_existing(output: Output) -> None:
    """Refuse before the work is done, where the result could not be written anyway.

    Raises:
        KeptFile: the file is there and ``force`` is not given, or its folder is missing.
    """
    if not output.path.parent.is_dir():
        raise KeptFile(f"{output.path}: there is no folder {output.path.parent}; make it first")
    if output.path.is_dir():
        raise KeptFile(f"{output.path}: is a folder; give the name of a file")
    if output.path.exists() and not output.force:
        raise KeptFile(
            f"{output.path}: is there already and stays as it is; give another --output, or --force"
            " to replace it"
        )


def refuse_better(output: Output, new: Provenance) -> None:
    """Refuse where the file that is there is the better one.

    Raises:
        KeptFile: the old residual or uncertainty is smaller, and ``accept_worse`` is not given.
    """
    if output.accept_worse or not output.path.exists():
        return
    try:
        old = read_provenance(output.path, output.record_at)
    except ConfigurationError:
        return
    if old is None or old.by != new.by:
        return
    worse = [
        f"its {what} is {before:.4g} and the new one {after:.4g}"
        for what, same, before, after in (
            (old.residual_of, old.residual_of == new.residual_of, old.residual, new.residual),
            (
                old.uncertainty_of,
                old.uncertainty_of == new.uncertainty_of,
                old.uncertainty,
                new.uncertainty,
            ),
        )
        if same and after > _SLACK * before
    ]
    if worse:
        raise KeptFile(
            f"{output.path}: the file of {old.made} is better and stays: {', '.join(worse)}."
            " Give another --output, or --force --accept-worse to replace it all the same"
        )


def write_kept(output: Output, text: str, new: Provenance, read: Callable[[Path], object]) -> None:
    """Write ``text``, which holds ``new``, by the rule of this module.

    ``read`` is the nodes' reader of such files; it is given the new file, in its folder.

    Raises:
        KeptFile: a file is there that stays.
        ConfigurationError: ``read`` refuses the new file (a fault of the calibration).
        OSError: the folder cannot be written.
    """
    refuse_existing(output)
    refuse_better(output, new)
    draft = output.path.with_name(f".{output.path.name}.{os.getpid()}")
    try:
        draft.write_text(text, encoding="utf-8")
        read(draft)
        if output.force:
            os.replace(draft, output.path)
        else:
            # Never replaces a file that came in the meantime.
            with output.path.open("x", encoding="utf-8") as file:
                file.write(text)
    except FileExistsError as error:
        raise KeptFile(f"{output.path}: is there already and stays as it is") from error
    finally:
        draft.unlink(missing_ok=True)


def fingerprints(paths: Iterable[Path]) -> tuple[str, ...]:
    """Names of input files with the first twelve digits of their SHA-256."""
    return tuple(
        f"{path.name} sha256 {hashlib.sha256(path.read_bytes()).hexdigest()[:12]}" for path in paths
    )


def now() -> str:
    """Date and time for a record, to the second, with the zone."""
    return datetime.now().astimezone().isoformat(timespec="seconds")
