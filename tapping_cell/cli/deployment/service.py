"""Texts of the files that make a cell a service of systemd.

One unit runs ``up``, which supervises the nodes: it restarts a node that ends or hangs, ends all
nodes if a required one is lost, and keeps a second cell out of the domain. A unit for each node
would repeat these rules in systemd's language, where the wrong ones could be changed alone.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from tapping_cell.cli.deployment.places import Places

OF_THE_VERSION = (
    "LD_LIBRARY_PATH",
    "PYTHONPATH",
    "AMENT_PREFIX_PATH",
    "ROS_DISTRO",
    "ROS_VERSION",
    "ROS_PYTHON_VERSION",
    "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
)
"""Variables of the shell that select the version of the package and of ROS."""
OF_THE_CELL = (
    "RMW_IMPLEMENTATION",
    "ROS_SECURITY_ENABLE",
    "ROS_SECURITY_STRATEGY",
    "ROS_SECURITY_KEYSTORE",
)
"""Other variables of the shell in which ``deploy`` is called that the service needs too."""

UNIT = """\
# Written by: python -m tapping_cell deploy. Change it with: systemctl edit {unit}
[Unit]
Description=Robot tapping cell {name}
{order}
StartLimitIntervalSec=600
StartLimitBurst=6

[Service]
Type=notify
User={name}
Group={name}
EnvironmentFile={configuration}/cell.env
EnvironmentFile={configuration}/version.env
WorkingDirectory={state}
StateDirectory={name}
StateDirectoryMode=0750
LogsDirectory={name}
LogsDirectoryMode=0750
UMask=0027
ExecStart=/usr/bin/env python3 -m tapping_cell up $CELL_OPTIONS

# `up` restarts its nodes. systemd restarts `up`: after a crash, if a required node is lost, and if
# the loop of `up` does not run for 30 s. The arm is never homed by this, and a stored stop stays.
Restart=on-failure
RestartSec=5
WatchdogSec=30
TimeoutStartSec=90
TimeoutStopSec=20
KillMode=mixed
OOMPolicy=continue
MemoryHigh=60%
MemoryMax=80%
CPUWeight=500
# `up` gives all nodes but the drivers of arm and tapper the usual priority.
Nice=-10
CPUQuota={quota}%
TasksMax=1024
LimitCORE=0

NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
ProtectSystem=strict
ProtectHome=yes
PrivateTmp=yes
{devices}
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectProc=invisible
LockPersonality=yes
MemoryDenyWriteExecute=yes
RemoveIPC=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged
SystemCallErrorNumber=EPERM

[Install]
WantedBy=multi-user.target
"""

LOG_ROTATION = """\
/var/log/{name}/*.log {{
    su {name} {name}
    size 10M
    rotate 5
    compress
    missingok
    notifempty
    copytruncate
}}
"""


def unit_text(places: Places, *, hardware: bool, network: bool, links: tuple[str, ...]) -> str:
    """Return the systemd unit. ``network``: the nodes communicate with other computers. ``links``:
    links to the adapters, such as ``tapping_cell/arm``."""
    # Only the order: a cell without a network must not wait for the time either.
    after = ["network-online.target" if network else "network.target", "time-sync.target"]
    devices = [f"dev-{escaped(link)}.device" for link in links]
    wants = [*(["network-online.target"] if network else []), *devices]
    order = [f"After={' '.join([*after, *devices])}"]
    if wants:
        order.append(f"Wants={' '.join(wants)}")
    return UNIT.format(
        unit=places.unit,
        name=places.name,
        order="\n".join(order),
        configuration=f"/etc/{places.name}",
        state=f"/var/lib/{places.name}",
        # Another process always finds a quarter of a processor: a login, or `systemctl stop`.
        quota=100 * (os.cpu_count() or 1) - 25,
        # A list of allowed kinds of devices would exclude those whose kernel module is loaded after
        # the start of the unit, such as an adapter that is plugged in later.
        devices="SupplementaryGroups=dialout video" if hardware else "PrivateDevices=yes",
    )


def escaped(path: str) -> str:
    """Return a path below /dev as in the name of its device unit: systemd-escape(1)."""
    return "".join(
        "-" if letter == "/" else letter if letter.isalnum() or letter in "_:." else
        f"\\x{ord(letter):02x}"
        for letter in path
    )  # fmt: skip


def environment_text(
    places: Places, options: str, domain: int, discovery: str, shell: Mapping[str, str]
) -> str:
    """Return the environment file of the service, with the options of ``up``."""
    kept = {key: shell[key] for key in OF_THE_CELL if shell.get(key)}
    values = {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": discovery,
        "CELL_OPTIONS": options,
        "HOME": f"/var/lib/{places.name}",
        # The nodes' output is in /var/log already; the copies that rcl writes end with the service.
        "ROS_LOG_DIR": "/tmp/ros",
        "PYTHONUNBUFFERED": "1",
        **kept,
    }
    head = f"# Environment of {places.unit}; after a change: systemctl restart {places.name}\n"
    return head + _lines(values)


def version_text(shell: Mapping[str, str]) -> str:
    """Return the environment file that makes the service run this version."""
    values = {key: shell[key] for key in OF_THE_VERSION if shell.get(key)}
    values["PATH"] = f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin:/bin"
    return _lines(values)


def _lines(values: Mapping[str, str]) -> str:
    return "".join(f"{key}={value}\n" for key, value in values.items())


def user_text(places: Places) -> str:
    """Return the sysusers.d entry of the user and group of the service."""
    return f'u {places.name} - "Robot tapping cell" /var/lib/{places.name}\n'
