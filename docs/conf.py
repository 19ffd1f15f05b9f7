"""Sphinx: the pages of docs/, the reference from docstrings, examples whose pictures it makes."""

import emmc_rig

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
exclude_patterns = ["_build", "examples", "gallery/index.md"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
suppress_warnings = ["config.cache"]  # the gallery's settings hold classes

autodoc_typehints = "description"
autodoc_member_order = "bysource"
python_use_unqualified_type_names = True

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"/plot_",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_memory": False,
    "remove_config_comments": True,
}
