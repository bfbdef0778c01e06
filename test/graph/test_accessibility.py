"""Check with axe-core that the page and the reports have no serious accessibility problem, in light
and dark colours and on a phone.

axe-core is not a dependency. Install axe-core with `npm install --no-save axe-core` in the root of
the repository, or set TAPPING_CELL_AXE=/path/of/axe.min.js. Without axe-core, these tests are
skipped.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from test_operator_in_chromium import (
    DRIVER,
    Page,
    browser_options,
    demanding,
    opened,
    webdriver,
)

from tapping_cell.report import objects_page
from tapping_cell.report.run import Run, RunObject, TapRow
from tapping_cell.report.run_folder import PAGE, write_folder
from tapping_cell.report.run_reader import IllustratedRun
from tapping_cell.se2 import Pose

ROOT = Path(__file__).resolve().parents[2]
INSTALLED = ROOT / "node_modules" / "axe-core" / "axe.min.js"
AXE = Path(os.environ.get("TAPPING_CELL_AXE") or INSTALLED)
if not AXE.is_file():
    pytest.skip(
        "axe-core is not installed: npm install --no-save axe-core, or TAPPING_CELL_AXE",
        allow_module_level=True,
    )

SERIOUS = ("serious", "critical")
DESKTOP, PHONE = (1366, 768), (390, 844)
SQUARE = ((-0.02, -0.02), (0.02, -0.02), (0.02, 0.02), (-0.02, 0.02))


def problems(driver: webdriver.Chrome) -> list[str]:
    """Return the serious problems that axe-core finds in the document, each with its first
    element."""
    driver.execute_script(AXE.read_text(encoding="utf-8"))
    found: dict[str, Any] = driver.execute_async_script(
        "const done = arguments[arguments.length - 1];"
        "axe.run(document).then(done, (error) => done({error: String(error)}));"
    )
    assert "error" not in found, found["error"]
    assert found["passes"], "axe-core has looked at nothing"
    return [
        f"{each['id']}: {each['help']}; {json.dumps(each['nodes'][0]['html'])[:300]}; "
        f"{each['nodes'][0]['failureSummary'][:300]}"
        for each in found["violations"]
        if each["impact"] in SERIOUS
    ]


def appearances(driver: webdriver.Chrome) -> Iterator[str]:
    """Show the document in both colour schemes, each at the width of a desktop and of a phone."""
    for width, height in (DESKTOP, PHONE):
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        for scheme in ("light", "dark"):
            media = [{"name": "prefers-color-scheme", "value": scheme}]
            driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": media})
            yield f"{scheme}, {width} pixels wide"


def audit(driver: webdriver.Chrome, what: str) -> dict[str, list[str]]:
    """Return the serious problems of the document for each colour scheme and width."""
    found = {f"{what}, {appearance}": problems(driver) for appearance in appearances(driver)}
    folder = os.environ.get("TAPPING_CELL_PICTURES")
    if folder:
        for appearance in appearances(driver):
            name = f"{what} {appearance}".replace(",", "").replace(" ", "_")
            driver.save_screenshot(str(Path(folder) / f"{name}.png"))
    return {appearance: each for appearance, each in found.items() if each}


@pytest.fixture
def driver(tmp_path: Path) -> Iterator[webdriver.Chrome]:
    options = browser_options(tmp_path)
    made = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield made
    made.quit()


def test_the_report_of_an_arrangement(driver: webdriver.Chrome, tmp_path: Path) -> None:
    one, other = Pose(-0.1, 0.0, 0.0), Pose(0.1, 0.0, 0.5)
    why = "'disk' goes to its goal: its goal and a path to it are free"
    tap = TapRow(
        *(1, 1, "optimal", "fired", one, one, other, other, other, one, 0.4, 0.1),
        object_name="disk",
        purpose=why,
        reason="a reason",
        at_rest_at=4.0,
    )
    run = Run(
        name="arrangement",
        objects=tuple(
            RunObject(name, SQUARE, one, other, other, other, (0.001, 0.02), 1, "reached")
            for name in ("disk", "square", "bar", "ring", "star", "plate", "block", "tile")
        ),
        taps=(tap,),
        outcome="failed",
        wall_time=20.0,
        seed=None,
        versions={},
        error_code=412,
        error_msg="'bar' cannot be reached",
        table_size=(0.6, 0.44),
        began=1.7e9,
        contacts=(("disk", "bar"),),
    )
    path = tmp_path / PAGE
    path.write_text(objects_page.page(IllustratedRun(run, ())), encoding="utf-8")
    driver.get(path.as_uri())
    assert not audit(driver, "arrangement report")


@demanding
def test_the_page_and_the_report_of_its_run(tmp_path: Path) -> None:
    with opened(tmp_path) as page:
        page.ready()
        found = audit(page.driver, "idle")
        for each in page.driver.find_elements("css selector", "details"):
            page.driver.execute_script("arguments[0].open = true", each)
        found |= audit(page.driver, "everything open")
        found |= asked(page)
        found |= stopped(page)
        (folder,) = (path.parent for path in (tmp_path / "runs").glob("*/summary.json"))
        write_folder(folder)
        page.driver.get((folder / PAGE).as_uri())
        found |= audit(page.driver, "run report")
    assert not found, json.dumps(found, indent=2)


def asked(page: Page) -> dict[str, list[str]]:
    """Audit the page while a planned tap waits for confirmation; then confirm the tap."""
    page.element("ask").click()
    page.wait(lambda: "is on" in page.text("settings-answer"), "the planner asks from now on")
    seen = page.client.object_pose()
    page.type_goal(f"{1e3 * seen.x - 30:.1f}", f"{1e3 * seen.y:.1f}", 0)
    page.element("send").click()
    page.wait(lambda: page.element("planned-yes").is_displayed(), "a tap is proposed")
    found = audit(page.driver, "a tap is proposed")
    page.element("ask").click()
    page.wait(lambda: "is off" in page.text("settings-answer"), "the planner asks no more")

    def reached() -> bool:
        # Confirm the tap that is shown. Later taps need no confirmation.
        answer = page.element("planned-yes")
        if answer.is_displayed() and answer.is_enabled():
            answer.click()
        return "reached" in page.text("goal-words")

    page.wait(reached, "the goal", 150.0)
    return found


def stopped(page: Page) -> dict[str, list[str]]:
    """Audit the page after STOP, first with the recovery steps, then with the confirmation dialog
    of a step."""
    page.element("stop").click()
    page.wait(lambda: page.mode() == "stopped", "the stop")
    found = audit(page.driver, "stopped")
    page.wait(lambda: page.driver.find_elements("id", "step-clear"), "the page offers to clear")
    page.driver.execute_script("document.getElementById('step-clear').click()")
    page.wait(lambda: page.element("confirm-yes").is_displayed(), "the question")
    return found | audit(page.driver, "a question is asked")
