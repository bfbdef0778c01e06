"""Make a release: one version everywhere, and a tag from which bloom releases both packages.

    python environment/release.py 0.2.0

bloom and colcon do not look for a package inside another package. Therefore, the tag
``packages-0.2.0`` contains the packages side by side, in the folders ``tapping_cell`` and
``tapping_cell_msgs``, each with a ``CHANGELOG.rst`` made from ``CHANGELOG.md``. The tag ``0.2.0``
is on the commit of the sources. Nothing is pushed.
"""

from __future__ import annotations

import datetime
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("tapping_cell", "tapping_cell_msgs")
MESSAGES = "msg_defs"
PLACES = {
    "package.xml": r"<version>(.*)</version>",
    f"{MESSAGES}/package.xml": r"<version>(.*)</version>",
    "setup.py": r'    version="(.*)",',
    "tapping_cell/__init__.py": r'__version__ = "(.*)"',
}
"""Files that state the version, and the line with which each does."""


class ReleaseError(RuntimeError):
    """Raised if no release can be made; the message gives the reason and the remedy."""


def stated_versions(root: Path) -> dict[str, str]:
    """Return the version that each file of `PLACES` states."""
    found = {}
    for name, line in PLACES.items():
        stated = re.search(line, (root / name).read_text(encoding="utf-8"))
        found[name] = stated[1] if stated else ""
    return found


def changelog(markdown: str, package: str) -> str:
    """Return the released sections of CHANGELOG.md as the CHANGELOG.rst of a package, in the form
    that catkin_pkg and bloom read: one list for each version. A heading in a section is put in
    front of its entries."""
    title = f"Changelog for package {package}"
    lines = ["^" * len(title), title, "^" * len(title)]
    for heading, body in _sections(markdown):
        lines += ["", heading, "-" * len(heading), *_entries(body)]
    return "\n".join(lines) + "\n"


def _sections(markdown: str) -> Iterator[tuple[str, str]]:
    parts = re.split(r"^## (.*)\n", markdown, flags=re.MULTILINE)
    for heading, body in zip(parts[1::2], parts[2::2], strict=True):
        if re.fullmatch(r"\d+\.\d+\.\d+ \(\d{4}-\d\d-\d\d\)", heading):
            yield heading, body


def _entries(body: str) -> Iterator[str]:
    topic = ""
    for block in re.split(r"\n(?=- |#|\n)", body):
        text = " ".join(block.split())
        if text.startswith("#"):
            topic = text.lstrip("# ") + ": "
        elif text:
            yield "* " + topic + _restructured(text.removeprefix("- "))


def _restructured(text: str) -> str:
    """Return a line of Markdown as reStructuredText; of a link, only its text remains."""
    text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", text)
    parts = re.split(r"`([^`]*)`", text)
    for number, part in enumerate(parts):
        if number % 2:
            parts[number] = f"``{part}``"
        else:
            # An escaped space ends a literal before a letter.
            joined = number > 0 and re.match(r"\w", part)
            parts[number] = ("\\ " if joined else "") + re.sub(r"([*_|\\])", r"\\\1", part)
    return "".join(parts)


def prepare(version: str, date: datetime.date) -> None:
    """Write the version into every file that states it, and the date into CHANGELOG.md.

    Raises:
        ReleaseError: ``version`` is not the one that CHANGELOG.md calls unreleased.
    """
    log = ROOT / "CHANGELOG.md"
    text, unreleased = log.read_text(encoding="utf-8"), f"\n## {version} (unreleased)\n"
    if unreleased not in text:
        raise ReleaseError(
            f"CHANGELOG.md has no section '{unreleased.strip()}': give the version of its first "
            "section, such as 0.2.0"
        )
    log.write_text(text.replace(unreleased, f"\n## {version} ({date})\n"), encoding="utf-8")
    for name, old in stated_versions(ROOT).items():
        file = ROOT / name
        wanted, present = (PLACES[name].replace("(.*)", text) for text in (version, old))
        content = file.read_text(encoding="utf-8").replace(present, wanted, 1)
        file.write_text(content, encoding="utf-8")


def side_by_side(commit: str) -> str:
    """Return a git tree with the packages of a commit side by side, each with its changelog."""
    markdown = _git("show", f"{commit}:CHANGELOG.md")
    entries = _git("ls-tree", commit).splitlines()
    parts = {
        PACKAGES[0]: [entry for entry in entries if not entry.endswith(f"\t{MESSAGES}")],
        PACKAGES[1]: _git("ls-tree", f"{commit}:{MESSAGES}").splitlines(),
    }
    folders = []
    for package, files in parts.items():
        blob = _git("hash-object", "-w", "--stdin", given=changelog(markdown, package))
        made = _git("mktree", given="\n".join([*files, f"100644 blob {blob}\tCHANGELOG.rst"]))
        folders.append(f"040000 tree {made}\t{package}")
    return _git("mktree", given="\n".join(folders))


def _git(*words: str, given: str | None = None) -> str:
    done = subprocess.run(
        ["git", *words], cwd=ROOT, input=given, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise ReleaseError(f"git {words[0]} failed: {done.stderr.strip()}")
    return done.stdout.rstrip("\n")


def release(version: str) -> str:
    """Commit the version, and set both tags. Return the name of the tag for bloom.

    Raises:
        ReleaseError: the work tree has changes, the version does not fit, or git fails.
    """
    if _git("status", "--porcelain"):
        raise ReleaseError("the work tree has changes: commit or remove them first")
    prepare(version, datetime.datetime.now(datetime.timezone.utc).date())
    _git("commit", "-am", f"Release {version}")
    _git("tag", version)
    tag = f"packages-{version}"
    words = ("-p", "HEAD", "-m", f"Release {version}: the packages side by side")
    _git("tag", tag, _git("commit-tree", side_by_side("HEAD"), *words))
    return tag


def main() -> int:
    """Run the program."""
    if len(sys.argv) != 2 or not re.fullmatch(r"\d+\.\d+\.\d+", sys.argv[1]):
        print("error: give the version, such as 0.2.0", file=sys.stderr)
        return 2
    try:
        tag = release(sys.argv[1])
    except ReleaseError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(
        f"tagged {sys.argv[1]} and {tag}. Next:\n\n"
        f"    git push origin HEAD {sys.argv[1]} {tag}\n"
        "    bloom-release --rosdistro jazzy --track jazzy tapping_cell\n\n"
        "The track's release tag is packages-:{version}."
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
