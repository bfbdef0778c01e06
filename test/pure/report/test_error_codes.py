"""Error codes are declared only in ErrorCode.msg, and each of them is reported somewhere."""

from __future__ import annotations

import re
from pathlib import Path

from tapping_cell.report import error_codes

ROOT = Path(__file__).resolve().parents[3]


def test_every_line_of_the_declaration_is_read() -> None:
    text = (ROOT / "msg_defs" / "msg" / "ErrorCode.msg").read_text(encoding="utf-8")
    assert len(error_codes.codes()) == len(re.findall("^uint16 ", text, re.MULTILINE)) > 50


def test_every_code_has_a_meaning_and_a_hint() -> None:
    for number, code in error_codes.codes().items():
        assert code.symptom and not code.symptom.endswith("."), code.name
        assert number == 0 or (code.cause.endswith(".") and code.remedy.endswith(".")), code.name


def test_every_code_is_reported_somewhere_in_the_package() -> None:
    sources = "".join(
        file.read_text(encoding="utf-8") for file in (ROOT / "tapping_cell").rglob("*.py")
    )
    used = set(re.findall(r"\bErrorCode\.([A-Z_]+)|error_codes\.number\(\"([A-Z_]+)\"\)", sources))
    declared = {code.name for code in error_codes.codes().values()}
    assert declared <= {a or b for a, b in used}


def test_a_code_of_a_later_version_has_no_hint_and_is_named_by_its_number() -> None:
    assert (error_codes.name(999), error_codes.hint(999)) == ("999", "")
