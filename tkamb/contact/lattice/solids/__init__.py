"""Cells with a material: stiffness, nonlinear residual, tangent."""
