"""Results folders without a report, because drawing the report is slow."""

from tkamb.files import replaced_together
from tkamb.io.claim import claimed_directory
from tkamb.run.maps import write_maps
from tkamb.run.results_folder import put_numbers


def keep(results, folder, maps=None):
    """Write results without a report, and return the folder.

    Args:
        results: the results.
        folder: path of the folder, which is created if it does not exist.
        maps: pressure maps; None: those of the results.
    """
    maps = results.maps if maps is None else maps
    with claimed_directory(folder) as place, replaced_together(place) as files:
        if maps is not None:
            write_maps(maps, files.path("contact.h5"))
        put_numbers(results, files)
    return folder
