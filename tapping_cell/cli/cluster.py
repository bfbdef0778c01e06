"""Executor on a Dask cluster, for ``evaluate --sweep --cluster ADDRESS``.

Every worker must have the same version of this package, and its files (cell, object, truth) under
the same paths. Dask is an optional dependency: ``pip install distributed``.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from tapping_cell.planning import PlanningError

CONNECTION_DEADLINE = "10s"


@contextmanager
def cluster_executor(address: str) -> Iterator[Executor]:
    """Connect to the scheduler at ``address`` (``tcp://host:8786`` or ``host:8786``).

    Raises:
        PlanningError: Dask is not installed, or no scheduler with a worker answers at ``address``.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise PlanningError(
            f"--cluster {address} needs Dask, which is not installed; pip install distributed"
        ) from error
    try:
        client = Client(address, timeout=CONNECTION_DEADLINE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise PlanningError(
            f"no Dask scheduler answers at {address} ({error}); start one with 'dask scheduler' "
            "and give the address that it prints"
        ) from error
    with client:
        if not client.nthreads():
            raise PlanningError(
                f"the Dask scheduler at {address} has no worker; start one on each computer with "
                f"'dask worker {address}'"
            )
        with client.get_executor() as executor:
            yield executor
