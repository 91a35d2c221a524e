"""Additions to the MkDocs build: lists of names, the gallery, formulae as MathML, checks of the result."""

import ast
import html
import logging
import re
from pathlib import Path

import gallery
from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

PACKAGE = Path(__file__).parents[1] / "mcc_jax"
LOG = logging.getLogger("mkdocs.hooks.mcc_jax")
_ELSEWHERE = re.compile(
    r'<(?:script|img|iframe|source)\b[^>]*\bsrc="(?:https?:)?//|<link\b[^>]*\bhref="(?:https?:)?//', re.I
)
_LEFT_OVER = re.compile(
    rf'class="arithmatex"|:math:|\.\. math::|^!(?:api|names|file|table|{"|".join(gallery.BLOCKS)})\b', re.M
)
_API = re.compile(r"^!api (\S+)$", re.M)
_NAMES = re.compile(r"^!names (\S+)$", re.M)
_FILE = re.compile(r"^!file (\S+)$", re.M)
_TABLE = re.compile(r"^!table (\S+) (.+)$", re.M)
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.S)


def public_names(module: str) -> list[tuple[str, str]]:
    """Every name that a module exports, in the order of the text, and the part of the module it is from."""
    folder = PACKAGE.joinpath(*module.split(".")[1:])
    file = next(f for f in (folder / "__init__.pyi", folder / "__init__.py", folder.with_suffix(".py")) if f.exists())
    body = ast.parse(file.read_text(encoding="utf-8")).body
    # `from . import calibrate` names a package, which has a page of its own.
    return [(a.name, n.module) for n in body if isinstance(n, ast.ImportFrom) and n.module for a in n.names]


def on_files(files, config, **_):
    """Add the pictures that are drawn while the pages are built, and kept nowhere else."""
    for path, content in gallery.files().items():
        files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown, **_):
    """Replace `!api mcc_jax.law` by an entry for each name of the module, `!names mcc_jax` by links to them.

    `!gallery`, `!sheet`, `!which-test` and `!look-alikes` are replaced by the output of `gallery.py`,
    `!file NAME` by a file at the top of the repository, `!table FILE HEADING` by a table of `benchmarks/results/`.
    """

    def entries(match):
        return "\n\n".join(f"::: {match[1]}.{name}" for name, _ in public_names(match[1]))

    def links(match):
        homes = {
            name: match[1] if part.startswith("_") else f"{match[1]}.{part}" for name, part in public_names(match[1])
        }
        return "\n".join(f"- [`{name}`][{home}.{name}]" for name, home in sorted(homes.items(), key=lambda i: i[1]))

    def table(match):
        text = (PACKAGE.parent / "benchmarks" / "results" / match[1]).read_text(encoding="utf-8")
        _, heading, rest = text.partition(f"## {match[2]}\n")
        if not heading:
            raise PluginError(f"{match[1]} has no table {match[2]}")
        return rest.partition("\n## ")[0].strip()

    markdown = _TABLE.sub(table, markdown)
    markdown = _FILE.sub(lambda match: (PACKAGE.parent / match[1]).read_text(encoding="utf-8"), markdown)
    return gallery.filled(_NAMES.sub(links, _API.sub(entries, markdown)))


def on_page_content(content, **_):
    """MathML instead of TeX: browsers draw it themselves, so that no page needs a script for its formulae."""

    def mathml(match):
        display = "block" if match[2] == "[" else "inline"
        return convert(html.unescape(match[3]), display=display)

    return _FORMULA.sub(mathml, content)


def on_post_page(output, page, **_):
    """Warn, which fails a strict build, if a page loads something from elsewhere or a formula or list was not made."""
    for what, pattern in (("loads from elsewhere", _ELSEWHERE), ("was not turned into HTML", _LEFT_OVER)):
        if found := pattern.search(output):
            LOG.warning("%s: %r %s", page.file.src_uri, found[0], what)
    return output
