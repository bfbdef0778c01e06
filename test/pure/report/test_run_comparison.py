"""The comparison of runs is a table that the reader can sort."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from report_parts import made_run, tap_row

from tapping_cell.report import objects_page, run_page
from tapping_cell.report.palette import DARK, SERIES, css_of_drawings
from tapping_cell.report.run import Run
from tapping_cell.report.run_comparison import comparison_page
from tapping_cell.report.run_reader import IllustratedRun
from tapping_cell.se2 import Pose

GOAL = Pose(0.0, 0.0, 0.0)
# Name, duration in s, start. Sorted as text, 10.0 would come before 9.0.
RUNS = [("run 2", 10.0, Pose(0.03, 0.0, 0.0)), ("run 10", 9.0, None), ("run 1", 100.0, GOAL)]


def page() -> str:
    runs = [made_run(name=name, goal=GOAL, wall_time=s, start=pose) for name, s, pose in RUNS]
    return shown(runs)


def shown(runs: list[Run]) -> str:
    return comparison_page(runs, [f"{run.name}/index.html" for run in runs])


def colours(text: str, what: str) -> list[str]:
    """Return the colours of the curves, of the legend or of the dashed tolerances."""
    pattern = {
        "curve": r'<polyline [^>]*stroke="(#\w+)"',
        "legend": r'<rect width="8" height="8" rx="1" fill="(#\w+)"',
        "tolerance": r'stroke="(#\w+)" stroke-width="1.5" stroke-dasharray',
    }[what]
    return re.findall(pattern, text)


@pytest.mark.parametrize("count", [2, len(SERIES), len(SERIES) + 1])
def test_runs_of_one_planner_have_different_colours_while_there_are_enough(count: int) -> None:
    runs = [made_run([tap_row()], name=f"run {k}", planner="optimal") for k in range(count)]
    text = shown(runs)
    own = count <= len(SERIES)
    assert colours(text, "legend") == list(SERIES[: count if own else 1])
    wanted = list(SERIES[:count]) if own else [SERIES[0]] * count
    assert colours(text, "curve") == 2 * wanted  # distance and rotation


def test_each_run_has_its_own_tolerance_in_the_charts_if_they_differ() -> None:
    runs = [made_run([tap_row()], name=f"run {k}", tolerance=(0.001 * k, 0.02 * k)) for k in (1, 2)]
    text = shown(runs)
    assert colours(text, "tolerance") == 2 * list(SERIES[:2]) and "Dashed" in text
    assert "1.00 mm, 1.15 deg" in text and "2.00 mm, 2.29 deg" in text
    same = shown([runs[0], runs[0]])
    assert not colours(same, "tolerance") and "Filled" in same


@pytest.mark.parametrize("kind", ["comparison", "run", "objects"])
def test_colours_of_drawings_and_legends_change_together_in_dark_mode(kind: str) -> None:
    """The dark colours are set for attributes of drawings, so a colour elsewhere stays light."""
    run = made_run([tap_row()], outline=((0.03, 0.0), (-0.02, 0.02), (-0.02, -0.02)))
    text = {"comparison": lambda: shown([run, run]), "run": lambda: run_page.page(
        IllustratedRun(run, ())), "objects": lambda: objects_page.page(IllustratedRun(run, ()))}[
        kind]()  # fmt: skip
    body = text.partition("<body")[2]
    everywhere = re.findall(r"#[0-9a-f]{6}\b", re.sub(r"<script.*?</script>", "", body, flags=re.S))
    drawn = re.findall(r'(?:fill|stroke)="(#[0-9a-f]{6})"', body)
    assert drawn and sorted(everywhere) == sorted(drawn)
    rules = css_of_drawings()
    for colour in set(drawn) & set(DARK):
        assert all(f'[{kind}="{colour}"]' in rules for kind in ("fill", "stroke"))


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
