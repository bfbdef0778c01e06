"""SROS 2 in the cell: enclave of each node and explanation of failures (docs/deploy.md)."""

from __future__ import annotations

import os
from collections.abc import Mapping

ENABLED = "ROS_SECURITY_ENABLE"


def is_enabled(environment: Mapping[str, str] = os.environ) -> bool:
    """Return whether ROS security is enabled in the environment."""
    return environment.get(ENABLED, "") == "true"


def enclave_of(node: str) -> str:
    """Return the enclave of a node of the cell, as named in config/security/cell.policy.xml."""
    return f"/tapping_cell/{node}"


def explain(error: BaseException) -> str | None:
    """Explain a failure to start with security enabled. Return None if security is not the
    cause."""
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
            "docs/deploy.md describes, and set ROS_SECURITY_KEYSTORE to it"
        )
    return None
