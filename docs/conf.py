"""Sphinx: the pages of docs/, the reference from docstrings, examples whose pictures it makes."""

import re
from pathlib import Path
from typing import Any

import typer
from pygments.lexers.special import TextLexer
from sphinx.highlighting import lexers
from typer.cli import get_docs_for_click

import emmc_rig
from emmc_rig.cli import app as command_line

project = "emmc-rig"
author = "the developers of emmc-rig"
copyright = "2026, the developers of emmc-rig"
version = release = emmc_rig.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
html_theme = "furo"
html_title = f"emmc-rig {release}"
html_static_path = ["static"]
html_css_files = ["pages.css"]
exclude_patterns = ["_build", "examples", "gallery/index.md"]
myst_heading_anchors = 3
highlight_language = "none"  # commands have no language
lexers["csv"] = TextLexer()  # Pygments has none; other viewers of the pages do
suppress_warnings = ["config.cache"]  # the gallery's settings hold classes

autodoc_typehints = "description"
autodoc_member_order = "bysource"
python_use_unqualified_type_names = True

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"/plot_",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_memory": False,
    "remove_config_comments": True,
    "thumbnail_size": (480, 270),
}


def whole_summaries(group: Any) -> None:
    """Let lists of commands have the first sentence of each whole, not its first 45 letters."""
    for command in getattr(group, "commands", {}).values():
        command.short_help = " ".join((command.help or "").partition("\n\n")[0].split())
        whole_summaries(command)


def write_command_line(_: object) -> None:
    """Write command-line.md: every command with its options, from the command line itself."""
    command = typer.main.get_command(command_line)
    whole_summaries(command)
    context = typer.Context(command, info_name="emmc-rig")
    text = get_docs_for_click(obj=command, ctx=context, name="emmc-rig", title="Every option")
    text = re.sub("^  (emmc-rig .*)$", r"    \1", text, flags=re.M)  # examples, as code
    Path(__file__).with_name("command-line.md").write_text(text, encoding="utf-8")


def setup(app: object) -> None:
    """Register what happens before pages are read."""
    app.connect("builder-inited", write_command_line)  # type: ignore[attr-defined]
