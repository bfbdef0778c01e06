"""State of the computer that nodes and verbs report."""

from __future__ import annotations

import contextlib
import os
import shutil
from pathlib import Path

MEGABYTE = 1_000_000


def disk_space(folder: Path) -> tuple[int, float]:
    """Return the free bytes of the disk of a folder, and their share of the disk. If the folder is
    missing, it would be made on the disk of its parent. Raises OSError."""
    existing = next(one for one in (folder, *folder.parents) if one.exists())
    usage = shutil.disk_usage(existing)
    return usage.free, usage.free / max(1, usage.total)


def temperature(sensors: Path = Path("/sys/class/thermal")) -> float | None:
    """Return the highest temperature of the computer's sensors in degrees Celsius; None if it has
    none."""
    found = []
    for sensor in sensors.glob("thermal_zone*/temp"):
        with contextlib.suppress(OSError, ValueError):
            found.append(int(sensor.read_text()) / 1000)
    return max(found, default=None)


def state(folder: Path) -> dict[str, object]:
    """Return disk, temperature, load, memory and clock of the computer. Unknown values are None."""
    free = share = available = None
    with contextlib.suppress(OSError):
        free, share = disk_space(folder)
    with contextlib.suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        line = next(line for line in lines if line.startswith("MemAvailable"))
        available = int(line.split()[1]) * 1024 // MEGABYTE
    return {
        "disk_free_mb": None if free is None else free // MEGABYTE,
        "disk_free_share": None if share is None else round(share, 3),
        "temperature_c": temperature(),
        "load": round(os.getloadavg()[0], 2),
        "memory_available_mb": available,
        "clock_synchronised": Path("/run/systemd/timesync/synchronized").exists() or None,
    }
