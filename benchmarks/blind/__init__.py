"""Blind test bench of the discovery workflow: sealed synthetic campaigns, runner, scorer."""

import os

# Many small factorisations in several processes: threads of the linear algebra would only get in each other's way.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
