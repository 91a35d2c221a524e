"""Synthetic campaigns with hidden effects, in NumPy alone: nothing here knows the library under test."""
