"""Common document structure, sections and style of the pages of runs."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from tapping_cell.report import error_codes, palette

_STYLE = (
    palette.css_variables()
    + palette.css_of_drawings()
    + """
*{box-sizing:border-box}
body{font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif;color:var(--ink);
background:var(--ground);margin:0}
main{max-width:1080px;margin:0 auto;padding:0 16px 40px}
header{margin:0 -16px 16px;padding:26px 24px 20px;color:#fff;background:var(--warn)}
header.good{background:var(--good)}header.bad{background:var(--bad)}
header h1{margin:.1em 0 .15em;font-size:clamp(1.5rem,4.5vw,2.3rem);line-height:1.2}
header p{margin:0}
.badge{display:inline-block;border:1px solid #ffffffaa;border-radius:99px;padding:0 .8em;
font-size:.85rem}
section{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:16px 18px;
margin:14px 0}
h2{font-size:1.15rem;margin:0 0 .6em}small{color:var(--muted);font-weight:normal}
.cards{display:grid;grid-template-columns:repeat(auto-fit,minmax(140px,1fr));gap:12px}
.cards div{display:flex;flex-direction:column}.cards span{color:var(--muted);font-size:.88rem}
.cards b{font-size:1.5rem;line-height:1.3}
.cards i{color:var(--muted);font-style:normal;font-size:.82rem}
.two{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,380px),1fr));gap:18px;
align-items:start}
.three{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,290px),1fr));gap:18px;
align-items:start}
.quiet{color:var(--muted)}
figure{margin:0;min-width:0}figcaption{color:var(--muted);font-size:.88rem;margin-top:4px}
.chart figcaption{color:var(--ink);margin:0 0 4px;font-weight:600}
img,svg{display:block;width:100%;height:auto}img{border-radius:6px}
svg text{font-family:system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
.chart svg{font-size:12px}
.plan{background:var(--card);border:1px solid var(--line);border-radius:6px}
.band{border-radius:4px}
.key{white-space:nowrap;margin-right:.8em}
.key i{display:inline-block;width:.8em;height:.8em;border-radius:2px;margin-right:.35em}
table{border-collapse:collapse;width:100%;font-size:.94rem}
th{text-align:left;font-weight:normal;color:var(--muted);padding:3px 12px 3px 0;
vertical-align:top}
td{padding:3px 8px 3px 0;vertical-align:top;font-variant-numeric:tabular-nums}
tr+tr{border-top:1px solid var(--line)}
.scroll{overflow-x:auto}
.wide th{border-bottom:1px solid var(--line)}.number{text-align:right}
.sorts th button{font:inherit;color:inherit;background:none;border:0;padding:0;text-align:left;
cursor:pointer}
.sorts th button:hover{color:var(--ink)}
.sorts [aria-sort] button{color:var(--ink);font-weight:600}
.sorts button::after{content:" \\2195";opacity:.5}.sorts [aria-sort] button::after{opacity:1}
.sorts [aria-sort=ascending] button::after{content:" \\25B2"}
.sorts [aria-sort=descending] button::after{content:" \\25BC"}
.trouble{border-left:5px solid var(--bad)}
pre{overflow-x:auto;background:var(--ground);padding:10px;border-radius:6px;font-size:.82rem}
details{margin:4px 0}summary{cursor:pointer;overflow-wrap:anywhere}
.good-word{color:var(--good)}.bad-word{color:var(--bad)}
.film{max-width:620px;margin:0 auto}
@media screen and (prefers-color-scheme:dark){
header{color:#08120c}header.bad{color:#1d0504}.badge{border-color:#0006}
.plan{background:#111a21}}
@media print{body{background:#fff;font-size:11px}main{max-width:none}
header{-webkit-print-color-adjust:exact;print-color-adjust:exact;margin:0 0 10px}
section{break-inside:avoid;border-color:#ccc}
svg,.key i{-webkit-print-color-adjust:exact;print-color-adjust:exact}
.two{grid-template-columns:1fr 1fr}.three{grid-template-columns:1fr 1fr 1fr}}
"""
)


def document(title: str, body: str) -> str:
    """Return a complete, self-contained page; ``body`` is HTML."""
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head>"
        f"<body><main>{body}</main></body></html>\n"
    )


def failure_section(code: int, message: str) -> str:
    """Return the section that states an error and what to do; empty if ``code`` is 0."""
    if not code:
        return ""
    advice = error_codes.hint(code)
    return (
        f'<section class="trouble"><h2>{escape(error_codes.name(code))} '
        f"<small>code {code}</small></h2><p>{escape(message)}</p>"
        + (f"<p><b>What to do:</b> {escape(advice)}</p>" if advice else "")
        + "</section>"
    )


def cards_section(cards: Iterable[tuple[str, str, str]]) -> str:
    """Return the section with the main results. Each card has a name, a value and a note."""
    return (
        '<section class="cards">'
        + "".join(
            f"<div><span>{escape(name)}</span><b>{escape(value)}</b><i>{escape(note)}</i></div>"
            for name, value, note in cards
        )
        + "</section>"
    )


def scrolling_table(name: str, content: str, kind: str = "wide") -> str:
    """Return a table that can be scrolled, with the keyboard too, if it is wider than the screen.

    ``name``: what the table shows, for screen readers. ``content``: rows; ``kind``: style classes.
    """
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(name)}">'
        f'<table class="{kind}">{content}</table></div>'
    )
