"""Reading and writing as root in folders that another user owns: no symbolic link is followed.

The user of the service could put a link to a file of the computer where root reads or writes. Each
folder below a trusted one is therefore opened by itself, and a link in its place is an error.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from pathlib import Path

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_FILE = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_NO_PLAIN_FILE = (errno.ENOENT, errno.ELOOP, errno.ENOTDIR, errno.ENXIO)


def read_inside(file: Path, base: Path, last: int | None = None) -> bytes | None:
    """Return the content of a file below the trusted folder ``base``, at most the ``last`` bytes of
    it. None if there is no regular file, or if a symbolic link below ``base`` leads to it.

    Raises:
        OSError: the file cannot be read.
    """
    try:
        folder = _folder(file.parent, base)
        try:
            descriptor = os.open(file.name, os.O_RDONLY | _FILE, dir_fd=folder)
        finally:
            os.close(folder)
    except OSError as error:
        if error.errno in _NO_PLAIN_FILE:
            return None
        raise
    found = os.fstat(descriptor)
    if not stat.S_ISREG(found.st_mode):
        os.close(descriptor)
        return None
    with open(descriptor, "rb") as stream:
        stream.seek(0 if last is None else max(0, found.st_size - last))
        return stream.read(-1 if last is None else last)


def write_inside(
    file: Path, base: Path, text: str, owner: tuple[int, int] | None, mode: int | None
) -> None:
    """Replace a file below the trusted folder ``base``, completely or not at all. The file and the
    folders that are made get ``owner`` (user and group), and the file ``mode``.

    Raises:
        OSError: the file cannot be written, or a symbolic link is in the place of a folder.
    """
    base.mkdir(parents=True, exist_ok=True)
    folder = _folder(file.parent, base, make=True, owner=owner)
    part = f".{file.name}.part"
    try:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(part, dir_fd=folder)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _FILE
        with open(os.open(part, flags, 0o666, dir_fd=folder), "w", encoding="utf-8") as stream:
            stream.write(text)
            if owner is not None:
                os.fchown(stream.fileno(), *owner)
            if mode is not None:
                os.fchmod(stream.fileno(), mode)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(part, file.name, src_dir_fd=folder, dst_dir_fd=folder)
        os.fsync(folder)
    finally:
        os.close(folder)


def _folder(
    folder: Path, base: Path, *, make: bool = False, owner: tuple[int, int] | None = None
) -> int:
    """Return a descriptor of a folder below ``base``."""
    descriptor = os.open(base, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    reached = base
    for name in folder.relative_to(base).parts:
        reached /= name
        try:
            made = False
            if make:
                try:
                    os.mkdir(name, 0o755, dir_fd=descriptor)
                    made = True
                except FileExistsError:
                    pass
            following = os.open(name, _FOLDER, dir_fd=descriptor)
            if made and owner is not None:
                os.fchown(following, *owner)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(reached)) from error
        finally:
            os.close(descriptor)
        descriptor = following
    return descriptor
