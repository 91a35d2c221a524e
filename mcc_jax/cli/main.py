"""The group of commands, and how each ends: exit status 0, 1, 2, 3 or 130, and at most one line on standard error."""

from __future__ import annotations

import _thread
import contextlib
import errno
import io
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator
from typing import Any

import click

from .._errors import InputError
from .calibrate import calibrate
from .convert import convert
from .demo import demo
from .discover import discover, power
from .outputs import export, report
from .session import BAD_INPUT, DEFECT, DONE, INTERRUPTED, PROGRAM
from .simulate import simulate

EPILOG = """\b
Examples:
  mcc-jax demo
  mcc-jax simulate --out sim --levels 0.5,1 --hold-s 30 --noise-um 0.02
  mcc-jax calibrate sim --out fit
  mcc-jax discover sim --out fit
  mcc-jax report fit
  mcc-jax export fit --format c --out law
  mcc-jax convert FS1.txt --out tests --diameters 200,190,180

\b
A campaign is a folder with particles.csv (particle,D1_um,D2_um,D3_um),
curves.csv (particle,time_s,force_mN,displacement_um) and, optionally,
campaign.toml.

\b
Exit status: 0 done; 2 bad input, reported in one line, nothing written;
3 done, but the calibration did not converge;
130 interrupted; 1 a defect of mcc-jax, please report it.

\b
Shell completion (bash; likewise zsh_source, fish_source):
  eval "$(_MCC_JAX_COMPLETE=bash_source mcc-jax)"
"""


class Stop(click.ClickException):
    """The end of a run before its time: the exit status, and what to say on standard error, nothing if empty."""

    def __init__(self, status: int, line: str) -> None:
        super().__init__(line)
        self.exit_code = status  # pyright: ignore[reportAttributeAccessIssue]  # click's own errors share theirs

    def show(self, file: Any = None) -> None:
        """Print the line."""
        if self.message:
            click.echo(one_line(f"{PROGRAM}: {self.message}"), err=True)


def one_line(text: str) -> str:
    """The text without line breaks and control characters."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in " ".join(text.split()))


def explain(error: BaseException, debug: bool) -> Stop:
    """What a run that ended with this error reports; `debug` prints the traceback of a defect."""
    match error:
        case KeyboardInterrupt() | click.Abort():
            return Stop(INTERRUPTED, "interrupted")
        case BrokenPipeError():  # the reader of our output has seen enough; Python flushes it once more at its end
            with contextlib.suppress(OSError, AttributeError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return Stop(DONE, "")
        case InputError():
            problem = str(error)
        case click.UsageError():
            command, problem = error.ctx.command_path if error.ctx else PROGRAM, one_line(error.format_message())
            problem += f"{'' if problem.endswith(('.', '?', ')')) else '.'} See '{command} --help'."
        case click.ClickException():
            problem = error.format_message()
        case MemoryError():
            problem = "there is not enough memory. Use fewer points or fewer particles."
        case OSError(errno=errno.ENOSPC | errno.EFBIG | errno.EDQUOT | errno.EIO):
            problem = f"output cannot be written: {error.strerror}. Free some disk space and run again."
        case _:
            if debug:
                click.echo("".join(traceback.format_exception(error)), err=True, nl=False)
            report = f"please report it{'' if debug else ' with the output of --debug'}"
            found = f"internal error: {type(error).__name__}: {one_line(str(error))[:300]}"
            return Stop(DEFECT, f"{found}. This is a defect of {PROGRAM}; {report}.")
    return Stop(BAD_INPUT, f"error: {problem}")


@contextlib.contextmanager
def _explained(debug: bool = False) -> Iterator[None]:
    try:
        yield
    except click.exceptions.Exit:
        raise
    except (Exception, KeyboardInterrupt) as error:
        raise explain(error, debug) from error


class OneLineGroup(click.Group):
    """A group of commands whose every failure is one line on standard error."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the options of the group itself."""
        with _explained():
            return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; whatever it raises becomes `Stop`."""
        with _explained(bool(ctx.params.get("debug"))):
            return super().invoke(ctx)


@click.group(
    cls=OneLineGroup,
    name=PROGRAM,
    epilog=EPILOG,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.option("--debug", is_flag=True, envvar="MCC_JAX_DEBUG", help="Show the traceback of an internal error.")
@click.version_option(package_name="mcc_jax", message="%(prog)s %(version)s", help="Show the version.")
@click.pass_context
def cli(ctx: click.Context, debug: bool) -> None:
    """Loading-unloading contact law of microcrystalline cellulose particles: simulate, calibrate, discover, report."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


for _command in (demo, simulate, convert, calibrate, discover, power, report, export):
    cli.add_command(_command)


def _terminate(number: int, _: Any) -> None:
    """End the process, which clears up what it had begun."""
    raise SystemExit(128 + number)


def _send(number: int, after_s: float) -> None:
    """Send the signal again, unless the process is gone by then."""
    again = threading.Timer(after_s, _thread.interrupt_main, (number,))
    again.daemon = True
    again.start()


def _interrupt(*_: Any) -> None:
    """Interrupt, and again unless the process is gone: raised in a library's callback from C, it would be swallowed."""
    _send(signal.SIGINT, after_s=5.0)
    raise KeyboardInterrupt


def _unraisable(found: Any) -> None:
    """What a signal's handler raised within a destructor would be lost there: send the signal again, outside of it."""
    match found.exc_value:
        case KeyboardInterrupt():
            _send(signal.SIGINT, after_s=0.05)
        case SystemExit(code=int(status)) if status > 128:
            _send(status - 128, after_s=0.05)
        case _:
            sys.__unraisablehook__(found)


def main() -> None:
    """Entry point of `mcc-jax` and `python -m mcc_jax`."""
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    sys.unraisablehook = _unraisable
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    for name in ("SIGTERM", "SIGHUP"):  # so that a run that is asked to end clears up
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is signal.SIG_DFL:
            signal.signal(getattr(signal, name), _terminate)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # names of particles may be any text, terminals may not
    try:
        cli.main(prog_name=PROGRAM)
    except SystemExit as end:
        if not (isinstance(end.code, int) and end.code > 128):  # not ended by a signal
            raise
        # All is cleared up by now. What is left, the libraries' own tear-down, once took over a minute: it waits for
        # compilers that are at work in other threads.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(end.code)
