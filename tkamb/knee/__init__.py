"""The knee: chain, loads, ligaments, muscles' lines, patella and the equations of one instant.

`tkamb.Knee` (`tkamb.knee.knee`) is the entry; docs/plug_in.md shows how it is used. Nothing here
reads a file.
"""
