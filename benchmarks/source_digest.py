"""Digest of the source code on which stored results of a benchmark depend."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path
from types import ModuleType


@functools.cache
def source_digest(*packages: ModuleType) -> str:
    """Return a hexadecimal digest of all modules of these packages. If this digest differs from the
    digest stored with a result, the result is obsolete."""
    digest = hashlib.sha256()
    for package in packages:
        for file in sorted(Path(str(package.__file__)).parent.rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]
