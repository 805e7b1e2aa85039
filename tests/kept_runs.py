"""Folders of results without a report, which takes longer to draw than all the rest."""

from tkamb.files import replaced_together
from tkamb.io.claim import claimed_directory
from tkamb.run.maps import write_maps
from tkamb.run.results_folder import put_numbers


def keep(results, folder, maps=None):
    """Write results into a folder as a run does, but for the report; return the folder.

    Args:
        results: what to keep.
        folder: where; made if it is not there.
        maps: instead of the results' own.
    """
    maps = results.maps if maps is None else maps
    with claimed_directory(folder) as place, replaced_together(place) as files:
        if maps is not None:
            write_maps(maps, files.path("contact.h5"))
        put_numbers(results, files)
    return folder
