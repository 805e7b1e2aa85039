"""The names of the views; where they look from is the page's (assets/controls.js)."""

CAMERAS = ("oblique", "anterior", "medial", "lateral", "top of insert", "whole leg")
