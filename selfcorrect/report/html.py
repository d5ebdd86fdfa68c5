"""The page around what is shown: every text is escaped, and nothing but the page's own script may run."""

import base64
import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib import resources
from string import Template
from typing import Any

from selfcorrect.settings import Settings
from selfcorrect.words import number

__all__ = ["assembled", "facts_sections", "section", "table"]

_JSON_ESCAPES = {ord("<"): "\\u003c", ord(">"): "\\u003e", ord("&"): "\\u0026", 0x2028: "\\u2028", 0x2029: "\\u2029"}


def assembled(
    *, title: str, lead: str, summary: str, body: str, data: Mapping[str, Any], scripts: Sequence[str]
) -> str:
    """A whole page.

    Args:
        title: plain text.
        lead: plain text under the title.
        summary: HTML that says what was gained.
        body: HTML of the rest.
        data: what the scripts read, for JSON.
        scripts: files of this package, in order.
    """
    code = "\n".join(_file(name) for name in ("pixels.js", *scripts))
    code = f'(() => {{\n"use strict";\n{code}}})();\n'
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    text = json.dumps(_plain(data), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return Template(_file("page.html")).substitute(
        title=escape(_unicode(title)),
        lead=escape(_unicode(lead)),
        summary=_unicode(summary),
        body=_unicode(body),
        data=_unicode(text).translate(_JSON_ESCAPES),
        style=_file("page.css"),
        script=code,
        digest=digest,
    )


def _file(name: str) -> str:
    return (resources.files("selfcorrect.report") / name).read_text(encoding="utf-8")


def _unicode(text: str) -> str:
    """Bytes of a file name that are not UTF-8 come as surrogates, which no page can hold."""
    return text.encode(errors="backslashreplace").decode()


def _plain(value: Any) -> Any:
    """JSON has no infinity and no NaN: None instead."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def table(caption: str, head: Sequence[str], rows: Iterable[Sequence[Any]], classes: str = "") -> str:
    """Rows of plain values, escaped; the first of each names it. Without a head where that is empty."""
    heads = "".join(f'<th scope="col">{escape(name)}</th>' for name in head)
    headed = f"<thead><tr>{heads}</tr></thead>" if any(head) else ""
    lines = []
    for name, *values in rows:
        cells = "".join(f"<td>{escape(number(value))}</td>" for value in values)
        lines.append(f'<tr><th scope="row">{escape(number(name))}</th>{cells}</tr>')
    return (
        f'<div class="scroll"><table class="{classes}"><caption>{escape(caption)}</caption>'
        f"{headed}<tbody>{''.join(lines)}</tbody></table></div>"
    )


def section(name: str, content: str, classes: str = "") -> str:
    """A section under a heading."""
    slug = name.lower().replace(" ", "-")
    return (
        f'<section class="{classes}" aria-labelledby="{escape(slug)}"><h2 id="{escape(slug)}">{escape(name)}</h2>'
        f"{content}</section>"
    )


def facts_sections(facts: Mapping[str, Any]) -> str:
    """Channels, repairs, seconds and settings of a run, as far as they are known."""
    parts = []
    if channels := facts.get("channels"):
        rows = [(role, ", ".join(names)) for role, names in channels.items()]
        rows += [(name, "the same at every pixel: not used") for name in facts.get("constant", ())]
        parts.append(table("Channels", (), rows))
    if (repairs := facts.get("repairs")) is not None:
        those = [(n, r["non_finite"], r["negative"]) for n, r in repairs.items() if r["non_finite"] or r["negative"]]
        if those:
            parts.append(table("Repairs, in pixels", ("buffer", "NaN or infinite", "negative"), those))
        else:
            parts.append("<p><strong>Repairs</strong><br>None: no NaN, infinite or negative pixel.</p>")
    if seconds := facts.get("seconds"):
        parts.append(table("Seconds", (), [(name, f"{value:.2f}") for name, value in seconds.items()]))
    work = {name: facts.get(name) for name in ("denoiser", "preset", "threads", "steps", "parameters", "version")}
    if any(value is not None for value in work.values()):
        parts.append(table("Work", (), [(k, v) for k, v in work.items() if v is not None]))
    columns = f'<div class="columns">{"".join(parts)}</div>' if parts else ""
    return columns + settings_table(facts.get("settings"), facts.get("preset"))


def settings_table(settings: Mapping[str, Any] | None, preset: str | None) -> str:
    """Every setting with its meaning; what differs from the preset comes first, and open."""
    if not settings:
        return ""
    fields = Settings.__dataclass_fields__
    usual = Settings.presets()[preset].to_dict() if preset in Settings.presets() else {}
    rows = [(name, value, fields[name].metadata["help"] if name in fields else "") for name, value in settings.items()]
    changed = [row for row in rows if usual and row[1] != usual.get(row[0])]
    head = ("setting", "value", "meaning")
    told = table(f"Changed from the preset {preset}", head, changed, "settings") if changed else ""
    whole = table("Settings", head, rows, "settings")
    return f"{told}<details><summary>All {len(rows)} settings</summary>{whole}</details>"
