"""Modules that make models/deep_knee_bend. All its numbers are in `dimensions`."""
