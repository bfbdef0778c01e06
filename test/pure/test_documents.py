"""The documents: all links have a target, and all subpackages and pages are mentioned."""

import re
from pathlib import Path

import pytest
import reference_pages

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), ROOT / "lab" / "README.md"])

FINDINGS = {
    "the striker is fired while the arm moves": (
        "test_no_shot_is_fired_after_the_arms_promise_to_stand_still_ends",
        "test_no_release_falls_into_a_motion_of_the_arm",
        "test_the_arm_stands_still_for_as_long_as_it_promised",
    ),
    "11 times the energy after a reset": (
        "test_the_real_firmware_does_not_move_unasked_and_homes_correctly",
        "test_the_logic_on_the_host",
    ),
    "STOP of the page is delayed by other connections": (
        "test_stop_is_not_blocked_by_full_or_busy_pages",
    ),
    "a stop is cleared while a source still holds it": (
        "test_an_emergency_stop_during_a_move_stops_the_arm_and_requires_homing",
        "test_a_stop_source_lost_while_active_requires_a_confirmation",
        "test_a_stop_source_that_does_not_repeat_its_level_requires_a_confirmation",
    ),
    "a restart forgets a stop": (
        "test_a_stop_survives_a_node_restart_and_prevents_homing",
        "test_an_arm_whose_stop_could_not_be_stored_does_not_start",
    ),
    "WITHDRAW without a tap moves the arm": (
        "test_a_withdrawal_without_a_tap_moves_nothing",
        "test_only_the_withdrawal_of_the_last_tap_parks_an_idle_arm",
    ),
    "SAFE is reported while charging": (
        "test_the_state_of_the_active_tap_is_never_overwritten_by_a_read",
    ),
    "a fault in mid-move cannot be cleared": (
        "test_a_fault_during_a_move_after_a_withdrawal_can_be_cleared",
        "test/pure/logic/test_state_machines.py",
    ),
    "one far-too-high id blocks all later taps": (
        "test_an_invalid_id_does_not_cause_later_taps_to_be_refused",
        "test_the_real_firmware_keeps_shot_numbers_until_an_operator_resets_them",
    ),
    "a press of the clear button before the stop clears it": (
        "test_the_real_firmware_requires_a_button_press_after_a_stop",
    ),
    "an object that was turned or is hidden is struck": (
        "test_an_object_away_from_its_planned_pose_is_not_struck",
    ),
    "files, names and downloads are not validated": (
        "test_only_the_recorders_own_folders_are_runs",
        "test_no_other_file_is_served",
        "test_anything_other_than_a_request_is_refused_with_a_message",
        "test_an_unreadable_file_gives_empty_content",
        "test_every_line_of_the_lock_is_exact_and_has_hashes",
    ),
}
"""What a review of the real nodes found, and the tests that fail if it comes back."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_points_to_an_existing_file(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), f"{page.name} points at {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_to_a_section_finds_its_heading(page: Path) -> None:
    for target, section in re.findall(r"\]\(([^)#:]*)#([^)]*)\)", page.read_text(encoding="utf-8")):
        headings = anchors(page.parent / target if target else page)
        assert section in headings, f"{page.name} points at {target}#{section}"


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub and the site give to the headings of a page."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", reference_pages.PAGES, ids=lambda page: page.name)
def test_the_reference_pages_are_up_to_date(page: Path) -> None:
    """If this fails, run: make reference"""
    assert page.read_text(encoding="utf-8") == reference_pages.PAGES[page]()


def test_every_page_is_linked() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    for page in PAGES:
        if page.parent != ROOT and "images" not in page.parts:
            assert page.name in text, f"nothing points at {page.relative_to(ROOT)}"


def test_every_subpackage_is_in_the_architecture_page() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    subpackages = {
        folder.name + "/"
        for folder in (ROOT / "tapping_cell").iterdir()
        if folder.is_dir() and (folder / "__init__.py").exists()
    }
    assert subpackages == set(re.findall(r"^\| `(\w+/)` \|", text, re.MULTILINE))


def test_every_test_that_the_safety_page_names_exists() -> None:
    page = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
    sources = "".join(
        file.read_text(encoding="utf-8") for file in (ROOT / "test").rglob("test_*.py")
    )
    named = set(re.findall(r"`(test_\w+)`", page))
    assert len(named) > 40
    assert {name for name in named if f"def {name}(" not in sources} == set()
    files = set(re.findall(r"`((?:test|firmware)/[\w/]+\.(?:py|c))`", page))
    assert {name for name in files if not (ROOT / name).exists()} == set()


@pytest.mark.parametrize("finding", FINDINGS)
def test_the_safety_page_names_the_tests_of_each_finding_of_the_first_review(finding: str) -> None:
    page = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
    assert [name for name in FINDINGS[finding] if f"`{name}`" not in page] == []
