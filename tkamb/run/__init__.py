"""Simulation of a scene: frames, contact, muscles, statuses, results, resumed runs."""
