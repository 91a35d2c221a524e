"""Text from the templates beside this file."""

from __future__ import annotations

import json
from typing import Any


def render(name: str, **values: Any) -> str:
    """The template of that name with the values put in; a value it wants and does not get is an error."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("mcc_jax.export"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # C and Markdown, not HTML
    )
    return environment.get_template(name).render(**values)


def quoted(text: str) -> str:
    """Any text in one line of ASCII that ends no comment, string or code block, wherever it is put."""
    return json.dumps(text, ensure_ascii=True).replace("*", "\\u002a").replace("`", "\\u0060").replace("?", "\\u003f")
