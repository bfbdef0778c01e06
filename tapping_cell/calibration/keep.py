"""Writing of calibrated files without accidental loss of an existing file, in particular of a
better one.

1. If there is no file, the new file is written.
2. If there is a file, it is replaced only if ``force`` is given.
3. With ``force``, the calibration record in the old file is compared with the new record if the
   same command made both records. If the old residual or uncertainty is smaller, the file is
   replaced only if ``accept_worse`` is given. A file without a record of this command (written by
   hand, for example) cannot be compared, and ``force`` replaces it.
4. The last ten replaced files are kept in the folder ``.history`` beside the file.

Before the new text replaces the old file, the nodes' reader checks it. A text that this reader
rejects is never written.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import os
import shutil
import stat
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from tapping_cell.configuration.provenance import Provenance, read_provenance
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.durable_file import part_of, replace_text, sync_folder

_SLACK = 1.01
"""Ratio of the new to the old value above which the new file counts as worse. The limit is above 1
because values in files are rounded and repeated fits differ slightly."""
HISTORY = ".history"
"""Folder of the earlier contents of calibrated files."""
KEPT = 10
"""Number of earlier contents that are kept of a file."""


class KeptFile(ValueError):
    """Raised if an existing file is kept; the message gives the reason and a remedy."""


@dataclass(frozen=True, slots=True)
class Output:
    """Output file of a calibration, and the user's permissions to replace an existing file."""

    path: Path
    force: bool = False
    accept_worse: bool = False
    record_at: tuple[str, ...] = ("calibration",)
    """Path of keys to the file's :class:`Provenance`."""


def refuse_existing(output: Output) -> None:
    """Check before the calibration that its result can be written.

    Raises:
        KeptFile: the file exists and ``force`` is not given, or its folder is missing.
    """
    if not output.path.parent.is_dir():
        raise KeptFile(
            f"{output.path}: the folder {output.path.parent} does not exist; create it first"
        )
    if output.path.is_dir():
        raise KeptFile(f"{output.path}: is a folder; give the name of a file")
    if output.path.exists() and not output.force:
        raise KeptFile(
            f"{output.path} exists already and was not replaced; give another --output, or "
            "--force to replace it"
        )


def refuse_better(output: Output, new: Provenance) -> None:
    """Check that the existing file is not better than the new one.

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
    before, after = (
        {("residual", r.residual_of): r.residual, ("uncertainty", r.uncertainty_of): r.uncertainty}
        for r in (old, new)
    )
    worse = [
        f"{key[1]}: old {value:.4g}, new {after[key]:.4g}"
        for key, value in before.items()
        if key in after and after[key] > _SLACK * value
    ]
    if worse:
        raise KeptFile(
            f"{output.path}: the existing file, made {old.made}, is more accurate than the new one"
            f" and was kept ({'; '.join(worse)}). Give another --output, or --force --accept-worse "
            "to replace it anyway"
        )


def write_kept(output: Output, text: str, new: Provenance, read: Callable[[Path], object]) -> None:
    """Write ``text``, which includes the calibration record ``new``, by the rules of this module.

    ``read`` is the function with which the nodes read such files. This function first reads a draft
    of the file; if it rejects the draft, the file is not written.

    Raises:
        KeptFile: an existing file is kept.
        ConfigurationError: ``read`` rejects the new file (an error of the calibration).
        OSError: the folder cannot be written.
    """
    refuse_existing(output)
    refuse_better(output, new)
    draft = output.path.with_name(f".{output.path.name}.{os.getpid()}")
    try:
        replace_text(draft, text)
        read(draft)
        if output.force:
            _give_rights_of(output.path, draft)
            keep_earlier(output.path)
            os.replace(draft, output.path)
            sync_folder(output.path.parent)
        else:
            _move_to_new(draft, output.path)
    except FileExistsError as error:
        raise KeptFile(
            f"{output.path} exists already and was not replaced; give another --output, or "
            "--force to replace it"
        ) from error
    finally:
        draft.unlink(missing_ok=True)


def earlier_files(path: Path) -> list[Path]:
    """Return the kept earlier contents of a file, the latest one first."""
    return sorted((path.parent / HISTORY).glob(f"{glob.escape(path.name)}.*Z"), reverse=True)


def undone_files(path: Path) -> list[Path]:
    """Return the contents that were taken back, the latest one first."""
    return sorted((path.parent / HISTORY).glob(f"{glob.escape(path.name)}.*Z.undone"), reverse=True)


def keep_earlier(path: Path, kept_as: Path | None = None) -> None:
    """Copy a file that is about to be replaced to the history, and delete the oldest copies.
    ``kept_as``: the file in whose history it is kept, if it is another one.

    Raises:
        OSError: the copy cannot be written.
    """
    kept_as = kept_as or path
    _copy_to_history(path, kept_as)
    for old in earlier_files(kept_as)[KEPT:]:
        old.unlink()


def _copy_to_history(path: Path, kept_as: Path, suffix: str = "") -> None:
    if not path.exists():
        return
    history = kept_as.parent / HISTORY
    if not history.exists():
        history.mkdir()
        _give_rights_of(kept_as.parent, history)
    when = datetime.now(timezone.utc).strftime("%Y-%m-%dT%H-%M-%S.%fZ")
    copy = history / f"{kept_as.name}.{when}{suffix}"
    # The copy gets its name when it is complete. The time of the copied file is kept.
    part = part_of(copy)
    shutil.copy2(path, part)
    part.replace(copy)


def _give_rights_of(old: Path, new: Path) -> None:
    """Give a new file the mode and, if that is allowed, the owner of the file that it replaces."""
    if not old.exists():
        return
    found = old.stat()
    with contextlib.suppress(PermissionError):
        os.chown(new, found.st_uid, found.st_gid)
    new.chmod(stat.S_IMODE(found.st_mode))


def undo(path: Path, read: Callable[[Path], object]) -> Path:
    """Give a file its latest earlier content, and return the path that this content had. The
    present content becomes ``NAME.TIME.undone`` in the history.

    Raises:
        KeptFile: no earlier content is kept.
        ConfigurationError: ``read`` rejects the earlier content.
        OSError: the file cannot be written.
    """
    earlier = earlier_files(path)
    if not earlier:
        raise KeptFile(f"{path}: no earlier content is kept in {path.parent / HISTORY}")
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        replace_text(draft, earlier[0].read_text(encoding="utf-8"))
        read(draft)
        _give_rights_of(path if path.exists() else earlier[0], draft)
        _copy_to_history(path, path, ".undone")
        os.replace(draft, path)
        sync_folder(path.parent)
    finally:
        draft.unlink(missing_ok=True)
    earlier[0].unlink()
    for old in undone_files(path)[KEPT:]:
        old.unlink()
    return earlier[0]


def _move_to_new(draft: Path, path: Path) -> None:
    """Give the complete file ``draft`` the name ``path``; do not replace a file that was created in
    the meantime.

    Raises:
        FileExistsError: ``path`` exists.
    """
    try:
        os.link(draft, path)
    except FileExistsError:
        raise
    except OSError:
        # The file system has no hard links. Reserve the name, then replace the empty file.
        path.touch(exist_ok=False)
        try:
            os.replace(draft, path)
        except OSError:
            path.unlink(missing_ok=True)
            raise


def fingerprints(paths: Iterable[Path]) -> tuple[str, ...]:
    """Return the names of input files with the first twelve digits of their SHA-256."""
    return tuple(
        f"{path.name} sha256 {hashlib.sha256(path.read_bytes()).hexdigest()[:12]}" for path in paths
    )


def now() -> str:
    """Return date and time for a record, to the second, with the time zone."""
    return datetime.now().astimezone().isoformat(timespec="seconds")
