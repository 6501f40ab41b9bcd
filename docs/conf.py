"""Configuration of the documentation, built by `make docs`."""

from __future__ import annotations

import json
import re
import sys
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

import click
from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxTranslator
from sphinx_gallery.scrapers import figure_rst
from sphinx_gallery.sorting import FileNameSortKey

from faintspot.cli import group, home_of
from faintspot.loop.control.options import ControlOptions
from faintspot.slopes.estimators.registry import all_tables, option_table
from faintspot.slopes.pipeline.settings import SharedOptions

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

project = "faintspot"
author = "the faintspot developers"
copyright = "the faintspot developers, BSD-3-Clause"
version = release = version_of("faintspot")

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_click",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["reference/options/*", "tutorials/GALLERY_HEADER.rst", "**sg_execution_times.rst"]
nitpicky = False

myst_enable_extensions = ["colon_fence", "dollarmath", "substitution"]
myst_heading_anchors = 4
suppress_warnings = ["config.cache", "myst.header"]


def _table(table: dict[str, Any]) -> str:
    """Return a stored table as Markdown: how it was measured, its cells, and when and where."""
    head, *rows = [f"| {' | '.join(row)} |" for row in (table["columns"], *table["rows"])]
    grid = "\n".join([head, "|" + "---|" * len(table["columns"]), *rows])
    command = f"`{table['command']}`, " if table["command"] else ""
    origin = f"*{command}{table['measured']}, version {table['version']}; processor: {table['processor']}.*"
    return f"{table['configuration']}\n\n{grid}\n\n{origin}"


def _results() -> dict[str, dict[str, str]]:
    """Return the stored results: `{{ page.name }}` is the figure or the table of that name."""
    found = {}
    for path in sorted((HERE / "results/data").glob("*.json")):
        data = json.loads(path.read_text(encoding="utf-8"))
        tables = {name: _table(table) for name, table in data["tables"].items()}
        found[path.stem] = {
            **data.get("figures", {}),
            **tables,
            "answer": data.get("answer", ""),
            "question": data.get("question", ""),
        }
    return found


myst_substitutions = _results()

templates_path = ["_templates"]
smartquotes_action = "qe"  # "--option" stays as it is typed
default_role = "py:obj"
html_math_renderer = "mathml"

autosummary_generate = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"
toc_object_entries_show_parents = "hide"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False


def figure_of_block(block: object, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save what a block of a tutorial leaves in its variable `figure`."""
    figure = block_vars["example_globals"].pop("figure", None)
    if figure is None:
        return ""
    path = next(block_vars["image_path_iterator"])
    figure.savefig(path, dpi=110)
    return str(figure_rst([path], gallery_conf["src_dir"]))


sphinx_gallery_conf = {
    "image_scrapers": (figure_of_block,),
    "examples_dirs": "tutorials",
    "gallery_dirs": "auto_tutorials",
    "within_subsection_order": FileNameSortKey,
    "filename_pattern": r"plot_",
    "download_all_examples": False,
    "show_signature": False,
    "min_reported_time": 1e9,
    "capture_repr": (),
    "remove_config_comments": True,
    "abort_on_example_error": True,
}

html_theme = "pydata_sphinx_theme"
html_title = "faintspot"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_copy_source = html_show_sourcelink = html_use_index = False
html_theme_options = {
    "show_prev_next": True,
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "header_links_before_dropdown": 6,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
# Pages of the first level that have none below them
html_sidebars: dict[str, list[str]] = {page: [] for page in ("index", "start")}
copybutton_prompt_text = r"\$ |>>> "
copybutton_prompt_is_regexp = True


def _links_to_files(app: object, document: str, source: list[str]) -> None:
    """Link to the files of the project as files: pages also read well beside the code."""
    up = "../" * (document.count("/") + 1)
    source[0] = re.sub(
        r"\]\((?:\.\./)+((?:examples|benchmarks|src|tests|README|CONTRIBUTING|SECURITY)[^)#]*)\)",
        rf"](<path:{up}\1>)",
        source[0],
    )


def _write_command_pages(app: Sphinx) -> None:
    """Write one page for each command of the command line."""
    folder = HERE / "reference/commands"
    folder.mkdir(exist_ok=True)
    for name in group.list_commands(click.Context(group)):
        directive = f".. click:: {home_of(name)}\n   :prog: faintspot {name}\n   :nested: full\n"
        text = f"```{{eval-rst}}\n{directive}```\n"
        page = folder / f"{name}.md"
        if not page.exists() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def _write_option_tables(app: Sphinx) -> None:
    """Write the tables of options, for the page of the configuration."""
    folder = HERE / "reference/options"
    folder.mkdir(exist_ok=True)
    tables = {**all_tables(SharedOptions), "control": option_table(ControlOptions)}
    for name, table in tables.items():
        (folder / f"{name}.md").write_text(f"{table}\n", encoding="utf-8")


def _formula(translator: SphinxTranslator, node: nodes.math | nodes.math_block) -> None:
    """Write a formula as MathML, which browsers draw by themselves, also where nothing can be fetched."""
    block = isinstance(node, nodes.math_block)
    formula = convert(node.astext(), display="block" if block else "inline")
    translator.body.append(f'<div class="formula">{formula}</div>' if block else formula)
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("builder-inited", _write_command_pages)
    app.connect("builder-inited", _write_option_tables)
    app.connect("source-read", _links_to_files)
    app.add_html_math_renderer("mathml", (_formula, None), (_formula, None))
