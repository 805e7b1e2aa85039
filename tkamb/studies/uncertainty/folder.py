"""What an uncertainty run writes beside its nominal results, all of it or none."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from tkamb.files import write_rows
from tkamb.io.hdf5_file import new_hdf5
from tkamb.run.results_folder import (
    BANDS_NAME,
    INDICES_NAME,
    SAMPLES_NAME,
    TORNADO_NAME,
    write_results,
)

if TYPE_CHECKING:
    from tkamb.studies.uncertainty.indices import SobolIndex
    from tkamb.studies.uncertainty.run import Uncertainty


def write_uncertainty(uncertainty: "Uncertainty", folder: Path) -> None:
    """Write the nominal results and, beside them, bands, tornado, samples and indices together.

    Raises:
        InputError: the folder cannot be written.
    """

    def write_samples(path: Path) -> None:
        with new_hdf5(path) as file:
            file["result_names"] = uncertainty.names
            file["input_names"] = [one.name for one in uncertainty.inputs]
            file["input_units"] = [one.unit for one in uncertainty.inputs]
            file["input_standard_deviations"] = [one.deviation for one in uncertainty.inputs]
            file["time_s"] = uncertainty.results["time_s"]
            for name, dtype in (("values", float), ("failed", bool), ("errors", float)):
                content = np.array([getattr(one, name) for one in uncertainty.samples], dtype)
                file.create_dataset(name, data=content, compression="gzip")
            problems = [one.problems.tolist() for one in uncertainty.samples]
            text = h5py.string_dtype()
            file.create_dataset("problems", data=problems, dtype=text, compression="gzip")

    more = {
        BANDS_NAME: lambda path: write_rows(path, _band_rows(uncertainty.bands)),
        TORNADO_NAME: lambda path: write_rows(path, _tornado_rows(uncertainty)),
        SAMPLES_NAME: write_samples,
    }
    if uncertainty.indices:
        more[INDICES_NAME] = lambda path: write_rows(path, _index_rows(uncertainty.indices))
    write_results(uncertainty.results, folder, more=more)


def _band_rows(columns: Mapping[str, Any]) -> list[Sequence[str]]:
    rows = zip(*(map(_cell, values) for values in columns.values()), strict=True)
    return [list(columns), *rows]


def _tornado_rows(uncertainty: "Uncertainty") -> list[Sequence[str]]:
    by_name = {one.name: one for one in uncertainty.inputs}
    rows: list[Sequence[str]] = [
        ("result", "input", "standard_deviation", "unit", "variance_share", "change_per_sd")
    ]
    for one in uncertainty.tornado:
        varied = by_name.get(one.name)
        deviation, unit = (_cell(varied.deviation), varied.unit) if varied else ("", "")
        rows.append((one.result, one.name, deviation, unit, _cell(one.share), _cell(one.change)))
    return rows


def _index_rows(indices: "Sequence[SobolIndex]") -> list[Sequence[str]]:
    head = ("result", "input", "first_order", "first_order_se", "total", "total_se", "rows")
    rows: list[Sequence[str]] = [head]
    for one in indices:
        numbers = (one.first, one.first_error, one.total, one.total_error)
        rows.append((one.result, one.name, *map(_cell, numbers), str(one.rows)))
    return rows


def _cell(value: float) -> str:
    return "" if np.isnan(value) else repr(float(value))
