"""Measure the load of the operator's page and the age of its image; run by hand, not by pytest.

    . ./env.sh; python test/graph/measure_operator_page.py

Starts the simulated graph with the node operator_page. Measures the processor time of this node,
first with no browser connected, then with the page open in headless Chromium. The age of an image
is the time from its stamp until the browser has drawn it.
"""

from __future__ import annotations

import os
import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path

from selenium import webdriver

from tapping_cell.cli.graph import SIMULATED, Graph, own_domain

SECONDS = 20.0
PORT = 8765


def cpu_seconds(process: int) -> float:
    """Return the user and system time that a process has used, in s."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def watch(process: int, sample: object = None) -> tuple[float, list[float]]:
    """Return the process's load in per cent of a core, and the results of ``sample``, which is
    called every 0.1 s."""
    began, used, seen = time.monotonic(), cpu_seconds(process), []
    while time.monotonic() < began + SECONDS:
        time.sleep(0.1)
        if callable(sample):
            seen.append(sample())
    return 100 * (cpu_seconds(process) - used) / (time.monotonic() - began), seen


def main() -> int:
    """Run the measurements and print them."""
    os.environ["ROS_DOMAIN_ID"] = str(own_domain().number)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    folder = Path(tempfile.mkdtemp(prefix="operator_page-"))
    ports = {"arm_port": folder / "arm", "tapper_port": folder / "tapper"}
    parameters: dict[str, dict[str, object]] = {
        "sim_world": dict(ports),
        "scara_arm": {"port": folder / "arm", "home_on_activate": True},
        "tapper_trigger": {"port": folder / "tapper"},
        "operator_page": {"port": PORT},
    }
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for flag in (
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        f"--user-data-dir={folder}/browser",
    ):
        options.add_argument(flag)
    with Graph(
        (*SIMULATED, "operator_page"), parameters, folder / "logs", {"HOME": str(folder)}
    ) as graph:
        process = graph.process_ids["operator_page"]
        log = folder / "logs" / "operator_page.log"
        while "operator page:" not in log.read_text():
            graph.check()
            time.sleep(0.2)
        time.sleep(5.0)
        print(f"no page open: {watch(process)[0]:.1f} % of a core")
        driver = webdriver.Chrome(
            options=options, service=webdriver.ChromeService(shutil.which("chromedriver"))
        )
        try:
            driver.get(f"http://localhost:{PORT}/")
            time.sleep(10.0)
            ask = (
                "return Object.values({...document.getElementById('picture').dataset}).map(Number)"
            )
            share, seen = watch(process, lambda: tuple(driver.execute_script(ask)))
        finally:
            driver.quit()
        delays = sorted(delay for _, delay in dict(seen).items())
        rate = (seen[-1][0] - seen[0][0]) / SECONDS
        print(f"one page open: {share:.1f} % of a core, {rate:.1f} pictures a second")
        print(
            f"from stamp to drawn: median {statistics.median(delays):.0f} ms, "
            f"least {delays[0]:.0f} ms, 95 % within {delays[int(0.95 * len(delays))]:.0f} ms"
        )
        print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    shutil.rmtree(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
