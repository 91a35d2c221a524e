"""How every command ends: exit status 0, 1, 2, 3 or 130, and at most one line on standard error."""

from __future__ import annotations

import errno
import os
import sys
import traceback
from collections.abc import Sequence
from typing import Any

import click

from .._errors import InputError

PROGRAM = "mcc-jax"
DONE, DEFECT, BAD_INPUT, NOT_CONVERGED, INTERRUPTED = 0, 1, 2, 3, 130


class Stop(Exception):
    """The end of a run before its time.

    Attributes:
        status: the exit status.
        line: what to say on standard error; nothing if empty.
    """

    def __init__(self, status: int, line: str) -> None:
        super().__init__(line)
        self.status, self.line = status, line


def one_line(text: str) -> str:
    """The text without line breaks and control characters."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in " ".join(text.split()))


def explain(error: BaseException, debug: bool) -> Stop:
    """What a run that ended with this error tells its user.

    Args:
        error: what was raised.
        debug: print the traceback of what is nobody's input error.
    """
    match error:
        case Stop():
            return error
        case KeyboardInterrupt() | click.Abort():
            return Stop(INTERRUPTED, "interrupted")
        case BrokenPipeError():
            return Stop(DONE, "")  # whoever reads our output has seen enough
        case InputError():
            return Stop(BAD_INPUT, f"error: {error}")
        case click.MissingParameter(param=click.Option(name="out"), ctx=click.Context(command_path=command)):
            return Stop(
                BAD_INPUT,
                f"error: no folder is given for the results. Add --out DIR, a new folder or one of earlier results; "
                f"see '{command} --help'.",
            )
        case click.UsageError():
            command = error.ctx.command_path if error.ctx else PROGRAM
            problem = one_line(error.format_message())
            return Stop(
                BAD_INPUT, f"error: {problem}{'' if problem.endswith(('.', '?', ')')) else '.'} See '{command} --help'."
            )
        case click.ClickException():
            return Stop(BAD_INPUT, f"error: {error.format_message()}")
        case MemoryError():
            return Stop(BAD_INPUT, "error: there is not enough memory. Use fewer points or fewer particles.")
        case OSError(errno=errno.ENOSPC | errno.EFBIG | errno.EDQUOT | errno.EIO):
            return Stop(BAD_INPUT, f"error: output cannot be written: {error.strerror}. Make room and run again.")
    if debug:
        click.echo("".join(traceback.format_exception(error)), err=True, nl=False)
        hint = ""
    else:
        hint = " with the output of --debug"
    name, text = type(error).__name__, one_line(str(error))
    if len(text) > 300:
        text = text[:300] + "..."
    return Stop(DEFECT, f"internal error: {name}: {text}. This is a defect of {PROGRAM}; please report it{hint}.")


class OneLineGroup(click.Group):
    """A group of commands whose every failure is one line on standard error."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; whatever it raises becomes `Stop`."""
        try:
            return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit):
            raise
        except (Exception, KeyboardInterrupt) as error:
            raise explain(error, bool(ctx.params.get("debug"))) from error

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        """Run and leave with an exit status; see `click.Command.main`."""
        if not standalone_mode:
            return self._main(args, prog_name, complete_var, windows_expand_args, extra)
        try:
            status = self._main(args, prog_name, complete_var, windows_expand_args, extra)
        except (Exception, KeyboardInterrupt) as error:
            stop = explain(error, bool(os.environ.get("MCC_JAX_DEBUG")))
            if stop.line:
                click.echo(one_line(f"{PROGRAM}: {stop.line}"), err=True)
            if isinstance(error.__cause__, BrokenPipeError):
                _silence_stdout()
            sys.exit(stop.status)
        sys.exit(status if isinstance(status, int) else DONE)

    def _main(self, args: Any, prog_name: str | None, complete_var: str | None, expand: bool, extra: dict) -> Any:
        return super().main(args, prog_name, complete_var, standalone_mode=False, windows_expand_args=expand, **extra)


def _silence_stdout() -> None:
    """Keep the interpreter from complaining about the broken pipe when it flushes at its end."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, AttributeError, ValueError):
        return
