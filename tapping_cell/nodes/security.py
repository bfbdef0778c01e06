"""SROS 2 in the cell: each node's enclave, and its failures in sentences (docs/security.md)."""

from __future__ import annotations

import os
from collections.abc import Mapping

ENABLED = "ROS_SECURITY_ENABLE"


def is_enabled(environment: Mapping[str, str] = os.environ) -> bool:
    """True where the environment asks ROS for security."""
    return environment.get(ENABLED, "") == "true"


def enclave_of(node: str) -> str:
    """The enclave of a node of the cell, as config/security/cell.policy.xml names it."""
    return f"/tapping_cell/{node}"


def explain(error: BaseException) -> str | None:
    """What a failure to start with security on means, None where it is about something else."""
    text = str(error)
    if not is_enabled():
        return None
    if "security libraries" in text:
        return (
            f"{ENABLED} is true, but this Fast DDS was built without security, as the wheels from "
            f"PyPI are: use ROS 2 from apt, or unset {ENABLED}"
        )
    if "SECURITY ERROR" in text:
        cause = text.split("SECURITY ERROR:", 1)[1].split(", at ")[0].strip()
        return (
            f"{ENABLED} is true, but the node's keys cannot be used: {cause}; make the keystore as "
            "docs/security.md describes, and set ROS_SECURITY_KEYSTORE to it"
        )
    return None
