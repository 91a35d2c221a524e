"""Blind test bench of the discovery workflow: sealed synthetic campaigns, runner, scorer."""
