"""The knee as an object on a Pinocchio model: contact, ligaments and extensor mechanism.

`tkamb.Knee` is the entry; docs/plug_in.md shows how it is used. Nothing here reads a file.
"""
