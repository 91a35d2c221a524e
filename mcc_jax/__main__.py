"""`python -m mcc_jax`: the same as the command `mcc-jax`."""

from .cli import run

if __name__ == "__main__":
    run()
