"""The viewer: drawings of a run, the page that displays them, and its server."""

CAMERAS = ("oblique", "anterior", "medial", "lateral", "top of insert", "whole leg", "button")
"""Names of the views. The page defines the direction of each view (assets/controls.js)."""
