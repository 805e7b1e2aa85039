"""The knee: chain, loads, ligaments, muscle lines, patella and the equations of one instant.

The public object is `tkamb.Knee` (`tkamb.knee.knee`); docs/plug_in.md shows its use. This package
reads no files.
"""
