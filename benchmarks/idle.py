"""Processor load and memory of the idle cell: the simulated graph with recorder and operator's page
and a stationary object.

Absolute loads depend on the machine; compare two versions in alternating runs. Memory is the
proportional set size, which divides shared pages among the processes that use them.
"""

from __future__ import annotations

import os
import re
import time
from pathlib import Path
from typing import Any

from benchmarks.rigs import cpu_seconds, simulated_graph, wait_for_rest
from tapping_cell.cli.graph import RECORDER, SIMULATED, own_domain
from tapping_cell.nodes.cell_node import choose_transport

DEFAULT_COUNT = 20
"""Duration of the measurement, in s."""
SETTLE_S = 5.0
"""Waiting time before the measurement, in s, from the moment at which the object is at rest."""


def measure(seconds: int) -> dict[str, Any]:
    """Return the load of each process as a share of a core, and its memory in MB."""
    domain = own_domain()
    domain.use()
    choose_transport(pictures=True)
    nodes = (*SIMULATED, RECORDER, "operator_page")
    with simulated_graph(nodes, {"operator_page": {"port": 0}}) as graph:
        wait_for_rest(graph)
        time.sleep(SETTLE_S)
        processes = graph.process_ids
        before, began = (
            {name: cpu_seconds(pid) for name, pid in processes.items()},
            time.monotonic(),
        )
        time.sleep(seconds)
        took = time.monotonic() - began
        graph.check()
        return {
            "cores": {
                name: (cpu_seconds(pid) - before[name]) / took for name, pid in processes.items()
            },
            "megabytes": {name: _memory(pid) for name, pid in processes.items()},
            "load": os.getloadavg()[0],
        }


def _memory(pid: int) -> float:
    """Return the proportional set size of a process, in MB."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    found = re.search(r"^Pss: +(\d+) kB", text, re.MULTILINE)
    assert found is not None
    return int(found[1]) * 1024 / 1e6


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    cores, megabytes = report["cores"], report["megabytes"]
    return [
        *(
            f"{name:16s}{100 * cores[name]:6.1f} % of a core{megabytes[name]:8.0f} MB"
            for name in cores
        ),
        f"{'together':16s}{100 * sum(cores.values()):6.1f} % of a core"
        f"{sum(megabytes.values()):8.0f} MB; load {report['load']:.1f} on {os.cpu_count()} cores",
    ]
