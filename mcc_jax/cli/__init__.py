"""The command line, `mcc-jax`: everything heavy is imported inside the commands, so that help comes at once."""

from .main import main as main
