"""Make the screenshots of the operator's page for docs/images; run by hand, not by pytest.

    . ./env.sh; python test/graph/picture_operator_page.py [FOLDER]

Starts the simulated graph with the page in headless Chromium and sends a goal with *Ask before
every tap*. While a tap after the first waits for confirmation, the page is captured at the width of
a desktop and of a phone. FOLDER is where the screenshots are written; the default is docs/images.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from test_operator_in_chromium import Page, opened

from tapping_cell.cli.graph import own_domain


def picture(page: Page, width: int, height: int, path: Path) -> None:
    """Save a screenshot of the page in a window of this size in pixels."""
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    page.driver.execute_script("scrollTo(0, 0)")
    page.driver.save_screenshot(str(path))


def main() -> int:
    """Make both screenshots."""
    os.environ["ROS_DOMAIN_ID"] = str(own_domain().number)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    images = Path(__file__).resolve().parents[2] / "docs" / "images"
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else images
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="page-") as name, opened(Path(name)) as page:
        page.ready()
        page.drag("ghost-outline", 90, 40)
        page.drag("ghost-handle", 8, 14)
        page.element("ask").click()
        page.wait(lambda: "is on" in page.text("settings-answer"), "the planner asks from now on")
        page.element("send").click()
        rows = "return document.querySelectorAll('#taps tbody tr').length"
        while not page.driver.execute_script(rows):
            # On a busy machine, a late image can end a tap, which is then proposed again.
            page.answer_proposal(confirm=True)
            page.wait(
                lambda: page.driver.execute_script(rows)
                or page.element("planned-yes").is_displayed(),
                "the first tap, or another proposal",
            )
        page.wait(lambda: page.element("planned-yes").is_displayed(), "the next tap is proposed")
        picture(page, 1366, 900, folder / "operator_page.png")
        picture(page, 390, 844, folder / "operator_page_phone.png")
    print(f"written to {folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
