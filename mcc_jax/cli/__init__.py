"""The command line, `mcc-jax`: everything heavy is imported inside the commands, so that help comes at once."""

from .entry import run as run
