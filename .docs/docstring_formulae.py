"""Docstrings as the pages need them: formulae between dollars instead of Sphinx's way, one entry for each name."""

import re
import textwrap

import griffe

_BLOCK = re.compile(r"^(?P<indent>[ ]*)\.\. math::[ ]*(?P<first>.*)\n(?P<rest>(?:(?P=indent)[ ]+\S.*\n|[ ]*\n)*)", re.M)
_INLINE = re.compile(r":math:`([^`]+)`")
_LITERAL = re.compile(r"(?<=\w)::$", re.M)
_SECTION = re.compile(r"^(?:Args|Attributes):\n(?:(?:[ ]+\S.*)?\n)*", re.M)
_ENTRY = re.compile(r"^(?P<indent>[ ]+)(?P<names>\w+(?:, \w+)+)(?P<text>: .*\n(?:(?P=indent)[ ]+\S.*\n)*)", re.M)


def in_markdown(text: str) -> str:
    """A docstring with its formulae between dollars, each block a paragraph, and with each argument on its own."""

    def block(match):
        indent = match["indent"]
        lines = textwrap.dedent(match["rest"]).strip()
        formula = " ".join(f"{match['first']} {lines}".split())
        return f"\n{indent}$$\n{indent}{formula}\n{indent}$$\n\n"

    def entries(match):
        return "".join(f"{match['indent']}{name}{match['text']}" for name in match["names"].split(", "))

    text = _BLOCK.sub(block, text + "\n")
    text = _SECTION.sub(lambda section: _ENTRY.sub(entries, section[0]), text)
    return _LITERAL.sub(":", _INLINE.sub(lambda m: f"${' '.join(m[1].split())}$", text)).rstrip()


class Formulae(griffe.Extension):
    """Rewrites every docstring before it is parsed."""

    def on_object(self, *, obj, **_):
        """Called for every module, class, function and attribute."""
        if obj.docstring:
            obj.docstring.value = in_markdown(obj.docstring.value)
