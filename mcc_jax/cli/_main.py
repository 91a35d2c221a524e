"""The group of commands."""

from __future__ import annotations

import io
import os
import signal
import sys
import warnings
from typing import Any

import click

from ._calibrate import calibrate
from ._convert import convert
from ._demo import demo
from ._discover import discover
from ._group import PROGRAM, OneLineGroup
from ._simulate import simulate

EPILOG = """\b
Examples:
  mcc-jax demo
  mcc-jax simulate --out sim --levels 0.5,1 --hold-s 30 --noise-um 0.02
  mcc-jax calibrate sim --out fit
  mcc-jax discover sim --out found
  mcc-jax convert FS1.txt --out tests --diameters 200,190,180

\b
A campaign is a folder with particles.csv (particle,D1_um,D2_um,D3_um),
curves.csv (particle,time_s,force_mN,displacement_um) and, optionally,
campaign.toml.

\b
Exit status: 0 done; 2 bad input, told in one line, nothing written;
130 interrupted; 1 a defect of mcc-jax, please report it.

\b
Shell completion (bash; likewise zsh_source, fish_source):
  eval "$(_MCC_JAX_COMPLETE=bash_source mcc-jax)"
"""


def _version(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not ctx.resilient_parsing:
        from importlib.metadata import PackageNotFoundError, version

        try:
            number = version(PROGRAM)
        except PackageNotFoundError:
            number = "(not installed)"
        click.echo(f"{PROGRAM} {number}")
        ctx.exit()


@click.group(
    cls=OneLineGroup,
    name=PROGRAM,
    epilog=EPILOG,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.option("--debug", is_flag=True, envvar="MCC_JAX_DEBUG", help="Show the traceback of an internal error.")
@click.option("--version", is_flag=True, is_eager=True, expose_value=False, callback=_version, help="Show the version.")
@click.pass_context
def cli(ctx: click.Context, debug: bool) -> None:
    """Loading-unloading contact law of micro-crystalline cellulose particles: simulate, calibrate, discover."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


for _command in (demo, simulate, convert, calibrate, discover):
    cli.add_command(_command)


class _Terminated(SystemExit):
    """The process was told to end; on the way out everything it had begun is cleared up."""


def _terminate(number: int, _: Any) -> None:
    raise _Terminated(128 + number)


def main() -> None:
    """Entry point of `mcc-jax` and `python -m mcc_jax`."""
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    for name in ("SIGTERM", "SIGHUP"):  # so that a run which is told to end clears up behind itself
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is signal.SIG_DFL:
            signal.signal(getattr(signal, name), _terminate)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # names of particles may be any text, terminals may not
    try:
        cli.main(prog_name=PROGRAM)
    except _Terminated as end:
        # All is cleared up by now. What is left, the libraries' own tear-down, once took over a minute.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(int(str(end.code)))
