"""Parametric implants: closed meshes of a femoral component and an insert from documented radii."""
