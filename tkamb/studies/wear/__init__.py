"""Wear, creep and a virtual knee simulator: many cycles of one motion on an insert that wears."""
