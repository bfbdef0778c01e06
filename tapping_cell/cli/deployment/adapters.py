"""USB adapters of a cell: what identifies them, and the udev rule that names them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

SYS = Path("/sys")


@dataclass(frozen=True, slots=True)
class Adapter:
    """A device node of a USB adapter."""

    subsystem: str
    """tty or video4linux."""
    vendor: str
    product: str
    serial: str
    """Serial number; empty if the adapter has none."""
    place: str
    """Number of the USB socket, such as ``1-1.2``."""
    index: str
    """Number of the interface (tty) or of the video device of this adapter."""

    def rule(self, link: str, group: str, unit: str) -> str:
        """Return the udev rule that gives the adapter the name ``/dev/LINK``, and ``group`` the
        permission to use it. When it is plugged in, the unit is started."""
        match = [f'SUBSYSTEM=="{self.subsystem}"']
        if self.serial:
            match += [
                f'ATTRS{{idVendor}}=="{self.vendor}"',
                f'ATTRS{{idProduct}}=="{self.product}"',
                f'ATTRS{{serial}}=="{self.serial}"',
            ]
        else:
            match.append(f'KERNELS=="{self.place}"')
        if self.subsystem == "tty":
            match.append(f'ENV{{ID_USB_INTERFACE_NUM}}=="{self.index}"')
        else:
            match.append(f'ATTR{{index}}=="{self.index}"')
        action = [f'SYMLINK+="{link}"', f'GROUP="{group}"', 'MODE="0660"', 'TAG+="systemd"']
        return ", ".join([*match, *action, f'ENV{{SYSTEMD_WANTS}}+="{unit}"'])


def adapter_of(port: Path, sys: Path = SYS) -> Adapter | None:
    """Return the USB adapter of a device node or of a link to it; None if there is none."""
    name = port.resolve().name
    for subsystem in ("tty", "video4linux"):
        device = sys / "class" / subsystem / name
        if not device.exists():
            continue
        parts = list(device.resolve().parents)
        interface = next((p for p in parts if (p / "bInterfaceNumber").exists()), None)
        usb = next((p for p in parts if (p / "idVendor").exists()), None)
        if usb is None or interface is None:
            return None
        index = (device / "index") if subsystem != "tty" else interface / "bInterfaceNumber"
        serial = _read(usb / "serial")
        # udev compares with patterns, and a quotation mark would end the value.
        plain = serial if re.fullmatch(r"[\w .:+=/-]+", serial) else ""
        return Adapter(
            subsystem,
            _read(usb / "idVendor"),
            _read(usb / "idProduct"),
            plain,
            usb.name,
            _read(index),
        )
    return None


def _read(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
