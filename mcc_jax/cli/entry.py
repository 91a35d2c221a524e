"""Where `mcc-jax` and `python -m mcc_jax` begin: says what to install where the packages of the command are not."""

from __future__ import annotations

import sys

from .._extras import MissingExtraError, extra


def run() -> None:
    """Run the command that the process was started with."""
    try:
        with extra("command"):
            from .main import main
    except MissingExtraError as error:
        sys.stderr.write(f"mcc-jax: error: {error}\n")
        sys.exit(2)
    main()
