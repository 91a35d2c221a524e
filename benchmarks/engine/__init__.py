"""Prototype of the comparison of models that is to replace `mcc_jax.discover`; it goes when that stands.

`design`: columns of a hypothesis around a state. `evidence`: its log marginal likelihood, scales at their mode.
`screen`: all formulas to first order. `refine`: a hypothesis at its own optimum. `misfit`: how formulas may be wrong.
`own`: what differs from test to test. `search`: all of it. `python -m benchmarks.engine.try_it` runs ten campaigns.
"""
