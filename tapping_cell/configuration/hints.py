"""Hints at the likely cause of a wrong word or number in a file that a person wrote."""

from __future__ import annotations

import difflib
import math
import re
import unicodedata
from collections.abc import Iterable

_MINUSES = "\u2212\u2010\u2011\u2012\u2013\u2014\ufe63\uff0d"
_SPACES = "\u00a0\u2007\u2009\u202f\u3000"
_QUOTES = "\u2018\u2019\u201a\u201c\u201d\u201e\u00ab\u00bb"
_INVISIBLE = "\u200b\u200c\u200d\u2060\ufeff\u00ad"
_PLAIN = str.maketrans(
    dict.fromkeys(_MINUSES, "-")
    | dict.fromkeys(_SPACES, " ")
    | dict.fromkeys(_QUOTES, '"')
    | dict.fromkeys(_INVISIBLE, "")
)
_NUMBER = r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
_ABOUT = re.compile(
    rf"(?:[~\u2248<>=\u2264\u2265]+|ca\.?|about)\s*({_NUMBER})"
    rf"|({_NUMBER})\s*(?:\u00b1|\+-|\+/-|\(|#|//).*"
)
"""A number with its accuracy, or with a remark that is not introduced as a comment."""
_GROUPED = r"[-+]?[0-9]{1,3}([ ,.'][0-9]{3})+([.,][0-9]+)?"
_MONTH = "(jan|feb|mar|m\u00e4r|mrz|apr|ma[iy]|jun|jul|aug|sep|o[ck]t|nov|de[cz])[a-z]*"
_DATE = re.compile(
    rf"[0-9]{{1,4}}[-./ ]+{_MONTH}\.?([-./ ]+[0-9]{{1,4}})?"
    rf"|{_MONTH}[-./ ]+[0-9]{{1,4}}"
    r"|[0-9]{4}-[0-9]{1,2}-[0-9]{1,2}( .*)?"
    r"|[0-9]{1,2}(?P<mark>[./])[0-9]{1,2}(?P=mark)[0-9]{2,4}( .*)?",
    re.IGNORECASE,
)
"""What spreadsheets make of numbers such as 1.2 or 3-5."""
_OTHER_UNITS = {
    "m": (("mm", 1e-3), ("cm", 1e-2), ("inches", 0.0254)),
    "mm": (("m", 1e3), ("cm", 10.0), ("inches", 25.4)),
    "rad": (("deg", math.pi / 180.0),),
    "kg": (("g", 1e-3),),
    "J": (("mJ", 1e-3),),
    "m/s": (("mm/s", 1e-3),),
    "rad/s": (("deg/s", math.pi / 180.0),),
    "s": (("ms", 1e-3),),
    "": (("percent", 1e-2),),
}
LARGEST_FRACTION = 2.0
"""Largest maximum of a number without a unit that may have been written in percent."""


def plain_characters(text: str) -> str:
    """Replace typographic minus signs, spaces and quotes by those of a keyboard."""
    return text.translate(_PLAIN)


def character_hint(text: str, tabs: bool = False) -> str:
    """Return a hint at the first character that looks like another one; empty if there is none.

    With ``tabs``, tabs are looked for too; YAML permits none in an indentation.
    """
    for character in text:
        if ord(character) in _PLAIN:
            name = unicodedata.name(character, "character").lower()
            named = f"{name} (U+{ord(character):04X})"
            if character in _INVISIBLE:
                return f"; delete the {named}"
            return f"; replace the {named} by the keyboard's character"
    if tabs and "\t" in text:
        return "; indent with spaces, not with tabs"
    return ""


def did_you_mean(word: object, choices: Iterable[str]) -> str:
    """Return the hint "; did you mean 'x'?" if one of ``choices`` resembles a word, else an empty
    text."""
    named = {_folded(choice): choice for choice in choices}
    folded = _folded(str(word)[:100])
    # "Grbl 1.1" and "grblHAL" are kinds of "grbl".
    longer = [own for own in named if len(own) > 2 and folded.startswith(own)]
    close = longer or difflib.get_close_matches(folded, named, n=1, cutoff=0.65)
    return f"; did you mean '{named[max(close, key=len)]}'?" if close else ""


def _folded(word: str) -> str:
    return re.sub(r"[^a-z0-9]", "", plain_characters(word).lower())


def number_hint(text: str, unit: str = "") -> str:
    """Return a hint at why a text is not a number; empty if nothing is recognised."""
    if _DATE.fullmatch(text.strip()):
        return (
            "; a spreadsheet has turned the number into a date: set the format of its cells to "
            "text before you enter or import the values again"
        )
    odd = character_hint(text)
    plain = plain_characters(text).strip().strip("\"'").strip()
    if re.fullmatch(rf"{_NUMBER}(\s+{_NUMBER})+", plain) and not re.fullmatch(_GROUPED, plain):
        return "; put commas between the numbers"
    if re.fullmatch(_NUMBER, plain):
        return f"{odd}: {plain}" if odd else f"; remove the quotes: {plain}"
    if re.fullmatch(r"[-+]?[0-9]*,[0-9]+(?:[eE][-+]?[0-9]+)?", plain):
        point = plain.replace(",", ".")
        if re.fullmatch(r"[-+]?[1-9][0-9]{0,2},[0-9]{3}", plain):
            return f"; write {point} or {plain.replace(',', '')}, without a comma"
        return f"; write a decimal point: {point}"
    if re.fullmatch(_GROUPED, plain):
        return "; write the number without separators between thousands, and a decimal point"
    if (found := re.fullmatch(rf"({_NUMBER})\s*%", plain)) and not unit:
        return f"; write {float(found[1]) / 100:.6g}"
    if found := re.fullmatch(rf"({_NUMBER})\s*([a-zA-Z\u00b0\u00b5%\"/^0-9]+)", plain):
        return f"; write the number without '{found[2]}'" + (f", in {unit}" if unit else "")
    if found := _ABOUT.fullmatch(plain):
        return f"; write the number alone: {found[1] or found[2]}"
    if re.search(r"(pi\b|\b(deg|rad)\w*\(|[0-9]\s*[*/]\s*[0-9])", plain):
        return "; expressions are not evaluated: write their value"
    return odd


def git_hint(text: str) -> str:
    """Return a sentence about the pointer or the first conflict marker that git left in a text;
    empty if there is none."""
    if text.startswith("version https://git-lfs"):
        return "the file is a pointer of git LFS; get its content with `git lfs pull`"
    found = re.search(r"^(<{7}|={7}|>{7})( .*)?$", text, re.MULTILINE)
    if found is None or not re.search(r"^(<{7}|>{7}) ", text, re.MULTILINE):
        return ""
    line = text.count("\n", 0, found.start()) + 1
    return (
        f"line {line} is the marker {found[1]} of a merge conflict; keep one of the two versions "
        "and delete the lines that begin with <<<<<<<, ======= and >>>>>>>"
    )


def unit_hint(value: float, unit: str, minimum: float, maximum: float) -> str:
    """Return a hint at another unit in which a value is in its range; empty if there is none."""
    if not abs(value) < 1e12 or (not unit and maximum > LARGEST_FRACTION):
        return ""
    fitting = [
        f"if the value is in {name}, write {value * factor:.6g}"
        for name, factor in _OTHER_UNITS.get(unit, ())
        if value and minimum <= value * factor <= maximum
    ]
    return "; " + ", and ".join(fitting) if fitting else ""
