"""Readers that convert files of a patient, motion, ground reaction or mesh to objects in SI."""
