"""One HTML file that opens offline: the frame, style and small parts that all our pages share."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from emmc_rig.version import __version__

CAVEATS = '<aside class="warnings" aria-label="How to read this"><h2>How to read this</h2>'
KINDS = {".png": "image/png", ".svg": "image/svg+xml", ".webp": "image/webp"}


@dataclass(frozen=True)
class Section:
    """key: its anchor. short: in the navigation. title: its heading. body: HTML."""

    key: str
    short: str
    title: str
    body: str


def framed(
    title: str,
    about: Sequence[str],
    caveats: Sequence[str],
    sections: Sequence[Section],
    style: str = "",
    script: str = "",
    lead: str = "",
) -> str:
    """Return the page. about: sentences under the title. caveats: how to read it.

    style, script: what only this page needs, as CSS and JavaScript. lead: HTML before the sections.
    """
    warnings = "".join(f"<li>{text(line)}</li>" for line in caveats)
    if warnings:
        lead = f"{CAVEATS}<ul>{warnings}</ul></aside>{lead}"
    report = resources.files("emmc_rig.pages").joinpath("report.html").read_text("utf-8")
    template = resources.files("emmc_rig.pages").joinpath("page.html").read_text("utf-8")
    common = re.search(r"<style>(.*?)</style>", report, re.DOTALL)
    assert common is not None
    parts = {
        "title": text(title),
        "generator": text(f"emmc-rig {__version__}"),
        "style": re.sub(r"\{\{\w+\}\}", "", common[1]),
        "own_style": style,
        "about": "".join(f"<p>{text(line)}</p>" for line in about),
        "lead": lead,
        "scripts": "; script-src 'unsafe-inline'" if script else "",
        "navigation": "".join(
            f'<li><a href="#{part.key}">{text(part.short)}</a></li>' for part in sections
        ),
        "sections": "".join(
            f'<section id="{part.key}"><h2>{text(part.title)}</h2>{part.body}</section>'
            for part in sections
        ),
        "script": f"<script>{script}</script>" if script else "",
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)


def text(value: object) -> str:
    """Return a value as HTML text, safe in attributes too."""
    return html.escape(str(value), quote=True)


def table_head(names: Sequence[str]) -> str:
    """Return the head of a table."""
    cells = "".join(f'<th scope="col">{text(name)}</th>' for name in names)
    return f"<thead><tr>{cells}</tr></thead>"


def embedded(path: Path) -> str:
    """Return a picture as a data address."""
    data = base64.b64encode(path.read_bytes()).decode()
    return f"data:{KINDS[path.suffix]};base64,{data}"


def provenance_table(provenance: dict[str, str]) -> str:
    """Return where everything came from, as a table."""
    rows = "".join(
        f'<tr><th scope="row">{text(key)}</th><td><code>{text(value)}</code></td></tr>'
        for key, value in provenance.items()
    )
    return f'<table class="narrow"><tbody>{rows}</tbody></table>'
