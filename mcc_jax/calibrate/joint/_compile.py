"""How the functions of the joint calibration are compiled."""

from __future__ import annotations

import functools

import equinox as eqx

compiled = functools.partial(eqx.filter_jit, compiler_options={"xla_backend_optimization_level": 1})
"""`equinox.filter_jit` with less optimisation: a fifth less time to compile, the same speed.

These functions are long chains of small operations, and a new campaign in a new process waits for their compilation
longer than for anything else.
"""
