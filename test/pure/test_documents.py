"""The documents: all links have a target, and all subpackages and pages are mentioned."""

import re
from pathlib import Path

import pytest
import reference_pages

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_points_to_an_existing_file(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), f"{page.name} points at {target}"


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


def test_every_finding_of_the_first_review_has_a_test() -> None:
    page = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| S(\d+) .*`test", page, re.MULTILINE)
    assert [int(number) for number in rows] == list(range(1, 13))
