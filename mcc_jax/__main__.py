"""`python -m mcc_jax`: the same as the command `mcc-jax`."""

from .cli import main

if __name__ == "__main__":
    main()
