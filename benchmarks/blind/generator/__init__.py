"""The first generator, in NumPy and SciPy; `interface` alone knows what the bench calls."""
