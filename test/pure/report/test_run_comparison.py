"""The comparison of runs is a table that the reader can sort."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from report_parts import made_run

from tapping_cell.report.run_comparison import comparison_page
from tapping_cell.se2 import Pose

GOAL = Pose(0.0, 0.0, 0.0)
# Name, duration in s, start. Sorted as text, 10.0 would come before 9.0.
RUNS = [("run 2", 10.0, Pose(0.03, 0.0, 0.0)), ("run 10", 9.0, None), ("run 1", 100.0, GOAL)]


def page() -> str:
    runs = [made_run(name=name, goal=GOAL, wall_time=s, start=pose) for name, s, pose in RUNS]
    return comparison_page(runs, [f"{run.name}/index.html" for run in runs])


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    chromium, driver = (
        next(filter(None, map(shutil.which, names)), None)
        for names in (("chromium", "chromium-browser", "chrome"), ("chromedriver",))
    )
    if chromium is None or driver is None:
        pytest.skip("Chromium and its chromedriver are not installed")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(flag)
    path: Path = tmp_path_factory.mktemp("page") / "comparison.html"
    path.write_text(page())
    opened = webdriver.Chrome(options, webdriver.ChromeService(driver))
    try:
        opened.get(path.as_uri())
        yield opened
    finally:
        opened.quit()


@pytest.mark.parametrize(
    ("heading", "ascending", "descending"),
    [
        ("run", ["run 1", "run 2", "run 10"], ["run 10", "run 2", "run 1"]),
        ("time", ["run 10", "run 2", "run 1"], ["run 1", "run 2", "run 10"]),
        # The start pose of run 10 is unknown, so it is last in both directions.
        ("distance at the start", ["run 1", "run 2", "run 10"], ["run 2", "run 1", "run 10"]),
    ],
)
def test_clicking_a_heading_sorts_the_runs(browser, heading, ascending, descending):
    head = browser.find_element("xpath", f"//th[button='{heading}']")
    for expected, direction in ((ascending, "ascending"), (descending, "descending")):
        head.find_element("tag name", "button").click()
        rows = browser.find_elements("css selector", "table.sorts tbody tr td:first-child")
        assert [row.text for row in rows] == expected
        assert head.get_attribute("aria-sort") == direction
