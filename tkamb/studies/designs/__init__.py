"""Parametric implants: closed meshes of femoral component and insert from published dimensions."""
