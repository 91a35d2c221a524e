"""mcc_jax."""
