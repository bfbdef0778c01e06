"""Digest of the source code that stored results of a benchmark depend on."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path
from types import ModuleType


@functools.cache
def source_digest(*packages: ModuleType) -> str:
    """Return a hexadecimal digest of all modules of these packages: any change of them makes
    results that were stored with it obsolete."""
    digest = hashlib.sha256()
    for package in packages:
        for file in sorted(Path(str(package.__file__)).parent.rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]
