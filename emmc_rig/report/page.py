"""One HTML file that opens offline: the templates of all pages, and how they are filled in."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from emmc_rig.model.notebook import data_address
from emmc_rig.model.view_axes import axes_of, picture_name, shows_parallax
from emmc_rig.reconstruction.verdict.rules import CONSISTENT
from emmc_rig.store.results import stated_words, unmeasured_words, worse_words
from emmc_rig.version import __version__

TEMPLATES = PackageLoader("emmc_rig.report")
VERDICTS = {
    "trust": ("You can trust this light field", "good"),
    "cannot tell": ("We cannot tell whether this light field is right", "watch"),
    "doubt": ("There is reason to doubt this light field", "watch"),
    "do not use": ("Do not use this light field", "bad"),
}
"""A verdict's level as a sentence, and the tone of a page with it."""


@dataclass(frozen=True)
class Section:
    """key: its anchor. title: its heading. body: HTML. short: in the navigation, if not title.

    about: a sentence on its content, beside the title; a section with it is folded.
    """

    key: str
    title: str
    body: str
    short: str = ""
    about: str = ""


@dataclass(frozen=True)
class Card:
    """A figure in a frame. tone: good, watch, bad, or "" for a plain one."""

    label: str
    value: str
    note: str
    tone: str = ""


@dataclass(frozen=True)
class Head:
    """The first thing on a page: what came out, why, and what to do next. tone: see `Card`.

    next: sentences, at least one; commands in backticks.
    """

    level: str
    why: str
    next: Sequence[str]
    tone: str = ""

    def __post_init__(self):
        if not self.next:
            raise ValueError(f"{self.level}: say what to do next")


def light_field_head(metrics: Mapping[str, object], source: str = "", viewer: bool = False) -> Head:
    """Return whether to trust a light field, and what to do next.

    metrics: as in metrics.json. source: the result's folder, or the scene, as a command takes it;
    empty where it is in memory alone. viewer: the page is nothing but the viewer.
    """
    verdict = metrics.get("verdict")
    if not isinstance(verdict, dict):
        why = "this light field was not reconstructed from frames, or they were not checked"
        return Head("No verdict", why, _uses(metrics, source, viewer))
    level, reasons = verdict["level"], verdict["reasons"]
    why = [reason["what"] for reason in reasons] or [CONSISTENT]
    if worse := worse_words(metrics):
        why.append(worse)
    if stated := stated_words(metrics):
        why.append(f"estimated accuracy {stated}")
    advice = str(metrics.get("advice") or "")
    remedies = list(filter(None, [*(reason["remedy"] for reason in reasons), advice]))
    uses = _uses(metrics, source, viewer) if level == "cannot tell" or not remedies else []
    words, tone = VERDICTS[level]
    if worse and tone == "good":
        words, tone = "Look at this light field with care", "watch"
    return Head(
        words,
        "; ".join(why),
        [*remedies, *uses],
        tone,
    )


def estimated(metrics: Mapping[str, object]) -> list[str]:
    """Return sentences with what was assumed or estimated; none where all was measured or given."""
    assumed, found = metrics.get("assumed"), metrics.get("estimated_from_frames")
    sentences = [f"{assumed}."] if assumed else []
    if isinstance(found, list) and found:
        words = "; ".join(map(str, found))
        sentences.append(f"Not given, so estimated from the frames: {words}.")
    if unmeasured := unmeasured_words(metrics):
        sentences.append(f"{unmeasured}.")
    return sentences


def _uses(metrics: Mapping[str, object], source: str, viewer: bool) -> list[str]:
    """Return what a light field can be used for."""
    look = "drag the picture to turn it, click to focus, scroll to open the aperture"
    axes = axes_of(metrics)
    if not shows_parallax(axes):
        named = picture_name(axes)
        look = f"drag the picture from {named} to {named}, scroll for a mean of several"
    if not source:
        return [look]
    named = shlex.quote(source)
    return [
        look,
        "share this page: it is a single file"
        if viewer
        else f"share it as a page to turn: `emmc-rig export {named}`",
        f"open it in other programs: `emmc-rig export {named} --format tiff`; "
        "`emmc-rig export --list` names all formats",
        f"draw it for a paper: `emmc-rig figure {named}`",
    ]


def typed(path: str | Path) -> str:
    """Return a path as it is typed in a command here: short where it lies below this folder."""
    whole = Path(path).absolute()
    here = Path.cwd()
    return shlex.quote(str(whole.relative_to(here) if whole.is_relative_to(here) else whole))


def number(value: float | None, form: str) -> str:
    """Return a number by its format, a dash for None and for values that are not finite."""
    return "–" if value is None or not math.isfinite(value) else format(value, form)


def worded(text: str) -> Markup:
    """Return a sentence with what stands in backticks as code."""
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def source(name: str) -> Markup:
    """Return a style sheet or a script as it is."""
    return Markup(TEMPLATES.get_source(ENVIRONMENT, name)[0])


ENVIRONMENT = Environment(
    loader=TEMPLATES,
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
ENVIRONMENT.filters.update(number=number, worded=worded)
ENVIRONMENT.globals.update(source=source, generator=f"emmc-rig {__version__}")


def fragment(template: str, **values: object) -> Markup:
    """Return a template filled in; text is escaped unless it is Markup."""
    return Markup(ENVIRONMENT.get_template(template).render(**values).lstrip())


def part(name: str, *given: object, **values: object) -> Markup:
    """Return a part of all pages (a macro of parts.html), such as a table; text is escaped."""
    parts = ENVIRONMENT.get_template("parts.html").module
    return Markup(getattr(parts, name)(*given, **values).lstrip())


def framed(
    title: str,
    about: Sequence[str] = (),
    caveats: Sequence[str] = (),
    sections: Sequence[Section] = (),
    styles: Sequence[str] = (),
    lead: str = "",
    *,
    head: Head,
    kind: str = "",
    scripts: Sequence[str] = (),
    data: Mapping[str, object] | None = None,
) -> str:
    """Return a page.

    about: sentences under the title. caveats: how to read it. styles, scripts: files beside the
    templates that only this page needs. head: comes first. lead: HTML before the sections. kind:
    class of the page, for its style. data: what the scripts read, by the id of its element.
    """
    return fragment(
        "page.html", title=title, about=about, caveats=caveats, sections=sections, styles=styles,
        lead=lead, summary=head, kind=kind, scripts=scripts, data=data or {},
    )  # fmt: skip


def provenance_section(provenance: Mapping[str, object]) -> Section:
    """Return where everything came from."""
    body = part("facts", provenance.items(), code=True)
    return Section(
        "provenance",
        "Provenance",
        body,
        about="What is needed to make this again: command, versions and settings.",
    )


def embedded(path: Path) -> str:
    """Return a picture as a data address."""
    return data_address(path.read_bytes(), path.suffix)
