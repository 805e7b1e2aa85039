"""See a run and turn it around: what is drawn, the page that draws it, and its server."""

CAMERAS = ("oblique", "anterior", "medial", "lateral", "top of insert", "whole leg")
"""The names of the views; where they look from is the page's (assets/controls.js)."""
