"""See a run and turn it around: what is drawn, the page that draws it, and its server."""

CAMERAS = ("oblique", "anterior", "medial", "lateral", "top of insert", "whole leg")
"""Names of the views. The page defines the direction of each view (assets/controls.js)."""
