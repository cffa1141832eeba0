"""How Sphinx makes the manual: `make docs`."""

import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "src")]
# Examples print plain lines, wherever the manual is built.
os.environ.update(NO_COLOR="1", MPLBACKEND="agg")

from difftetvr import __version__  # noqa: E402

project = "DiffTetVR for Python"
author = "the authors of DiffTetVR for Python"
release = version = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
    "extensions.code_links",
    "extensions.command_help",
    "extensions.docstrings",
    "extensions.example_links",
]
exclude_patterns = ["_build", "gallery/**/*.ipynb", "gallery/**/*.py", "gallery/**/*.json", "gallery/**/*.md5"]

# ---- prose

myst_enable_extensions = ["attrs_inline", "colon_fence", "deflist"]
myst_heading_anchors = 3
copybutton_exclude = ".linenos, .gp, .go, .c1"  # comments beside commands are not copied along
suppress_warnings = ["config.cache"]  # the gallery's functions are named, not stored

# ---- the reference, from docstrings

smartquotes = False  # options keep their two hyphens
default_role = "py:obj"
add_module_names = False
autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
autosummary_generate = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"
# Names of other packages lead nowhere offline; single backticks are code, and links where they name something here.
nitpick_ignore_regex = [
    ("py:obj", ".*"),
    ("py:class", r"(torch|numpy|collections|pathlib|rich|PIL|types)\..*"),
    ("py:class", r"Tensor|device|dtype|Location|difftetvr\..*\.(X|_Item|_Summed|_Own)"),
]

# ---- the examples, run

sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"\.py$",
    "example_extensions": {".py"},
    "image_scrapers": ("extensions.gallery.scrape_pictures",),
    "reset_modules": (),
    "reset_argv": "extensions.gallery.output_folder",
    "reference_url": {"difftetvr": None},
    "doc_module": ("difftetvr",),
    "backreferences_dir": None,
    "abort_on_example_error": True,
    "capture_repr": (),
    "remove_config_comments": True,
    "show_memory": False,
    "write_computation_times": False,
    "show_signature": False,
    "download_all_examples": False,
    "min_reported_time": 1e9,
    "within_subsection_order": "extensions.gallery.Order",
    "thumbnail_size": (320, 240),
}

# ---- the pages

html_theme = "furo"
pygments_dark_style = "github-dark"
html_title = "DiffTetVR for Python"
html_static_path = ["_static"]
html_css_files = ["manual.css"]
html_show_sourcelink = False
html_copy_source = False
html_show_copyright = False
html_show_sphinx = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#1f5fb4", "color-brand-content": "#1f5fb4"},
    "dark_css_variables": {"color-brand-primary": "#7fb2ff", "color-brand-content": "#7fb2ff"},
    "navigation_with_keys": True,
}
