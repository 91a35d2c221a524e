"""The joint fit and sampler that discovery runs on: copies of modules that `mcc_jax.calibrate` had. Not public.

A calibration may change without them. They go when the search itself is replaced; nothing new belongs here.
"""
