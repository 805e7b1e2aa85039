"""Uncertainty of the results of a run: varied inputs give every result a band."""
