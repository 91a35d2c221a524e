"""Every page of the documentation works as shown: its files, Python blocks and commands are executed in order."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import jax
import pytest

from mcc_jax.cli.main import cli

PAGES = Path(__file__).parents[2] / ".docs" / "pages"
FENCE = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', re.M | re.S)
COMMAND = re.compile(r"(?:\w+=\S+ )*(?:uv run )?mcc-jax (.*)")
ALL = {str(page.relative_to(PAGES)): page.read_text(encoding="utf-8") for page in sorted(PAGES.rglob("*.md"))}
# Languages: a title names a file to write; `sh` is run, `console` refers to the reader's files and is only parsed.
KNOWN = {"python", "sh", "console", "toml", "csv", "text", "c"}


@dataclass(frozen=True)
class Block:
    language: str
    title: str
    text: str

    @property
    def commands(self):
        """Each line that calls mcc-jax, as its arguments."""
        found = [COMMAND.match(line) for line in self.text.splitlines()]
        return [shlex.split(match[1], comments=True) for match in found if match]


def blocks(text):
    return [Block(*match.groups(default="")) for match in FENCE.finditer(text)]


RUN = [page for page, text in ALL.items() if any(b.language in ("python", "sh") for b in blocks(text))]


@pytest.mark.extended
@pytest.mark.parametrize("page", RUN)
@pytest.mark.filterwarnings("default")
def test_page_works_as_shown(page, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "page"}
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # as in a reader's session
        for number, block in enumerate(blocks(ALL[page]), start=1):
            if block.language == "python":
                exec(compile(block.text, f"{page}, block {number}", "exec"), names)
            elif block.language == "sh":
                for arguments in block.commands:
                    result = run(*arguments)
                    assert result.exit_code == 0, f"{shlex.join(arguments)}\n{result.output}\n{result.exception!r}"
            elif block.title:
                Path(block.title).parent.mkdir(parents=True, exist_ok=True)
                Path(block.title).write_text(block.text, encoding="utf-8")


COMMANDS = [(page, c) for page, text in ALL.items() for b in blocks(text) for c in b.commands]


@pytest.mark.parametrize(("page", "arguments"), COMMANDS, ids=lambda x: x if isinstance(x, str) else x[0])
def test_command_parses(page, arguments):
    """By the command's own parser, without running anything: options that do not exist and bad choices raise."""
    cli.commands[arguments[0]].make_context(arguments[0], list(arguments[1:]))


@pytest.mark.parametrize("page", list(ALL))
def test_every_block_has_a_language_that_is_checked(page):
    languages = {b.language for b in blocks(ALL[page])}
    assert languages <= KNOWN, languages - KNOWN
    assert len(re.findall(r"^ *```", ALL[page], flags=re.M)) == 2 * len(blocks(ALL[page])), "a block is not closed"


@pytest.mark.parametrize("page", list(ALL))
def test_pages_load_no_external_resources(page):
    assert not re.search(r"!\[[^\]]*\]\(https?:|<(?:script|link|img|iframe)\b", ALL[page])


@pytest.mark.parametrize("page", [page for page in ALL if page.startswith("how-to/")])
def test_every_how_to_has_a_picture_that_is_there(page):
    shown = re.findall(r"^!\[([^\]]+)\]\(([^)]+)\)$", ALL[page], flags=re.M)
    assert shown
    assert all((PAGES / page).parent.joinpath(file).stat().st_size < 130_000 for _, file in shown)


def test_every_public_module_has_its_page():
    import mcc_jax

    documented = set(re.findall(r"mcc_jax\.([a-z]+)", mcc_jax.__doc__))
    shown = {match for text in ALL.values() for match in re.findall(r"^!api mcc_jax\.([a-z]+)$", text, flags=re.M)}
    assert documented <= shown, documented - shown
