"""Uncertainty of a run's results: its inputs are varied, and every result gets a band."""
