"""What an uncertainty run writes beside its nominal results, all of it or none."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tkamb.results import Results
from tkamb.results_folder import BANDS_NAME, SAMPLES_NAME, TORNADO_NAME, write_results
from tkamb.uncertainty.bands import Influence
from tkamb.uncertainty.inputs import VariedInput
from tkamb.uncertainty.sample import Sample


def write_uncertainty(
    results: Results,
    bands: Mapping[str, Any],
    tornado: Sequence[Influence],
    names: Sequence[str],
    inputs: Sequence[VariedInput],
    samples: Sequence[Sample],
    folder: Path,
) -> None:
    """Write the nominal results, bands.csv, tornado.csv and samples.h5 together.

    Raises:
        InputError: the folder cannot be written.
    """

    def write_samples(path: Path) -> None:
        with h5py.File(path, "w") as file:
            file["result_names"] = list(names)
            file["input_names"] = [one.name for one in inputs]
            file["input_units"] = [one.unit for one in inputs]
            file["input_standard_deviations"] = [one.deviation for one in inputs]
            file["time_s"] = results["time_s"]
            for name, dtype in (("values", float), ("failed", bool), ("errors", float)):
                content = np.array([getattr(one, name) for one in samples], dtype)
                file.create_dataset(name, data=content, compression="gzip")

    more = {
        BANDS_NAME: lambda path: path.write_text(_table_text(bands), encoding="utf-8"),
        TORNADO_NAME: lambda path: path.write_text(_tornado_text(tornado, inputs), "utf-8"),
        SAMPLES_NAME: write_samples,
    }
    write_results(results, folder, more=more)


def _table_text(columns: Mapping[str, Any]) -> str:
    rows = zip(*(map(_cell, values) for values in columns.values()), strict=True)
    return _csv([list(columns), *rows])


def _tornado_text(tornado: Sequence[Influence], inputs: Sequence[VariedInput]) -> str:
    known = {one.name: one for one in inputs}
    rows: list[Sequence[str]] = [
        ("result", "input", "standard_deviation", "unit", "variance_share", "change_per_sd")
    ]
    for one in tornado:
        given = known.get(one.name)
        deviation, unit = (_cell(given.deviation), given.unit) if given else ("", "")
        rows.append((one.result, one.name, deviation, unit, _cell(one.share), _cell(one.change)))
    return _csv(rows)


def _csv(rows: Sequence[Sequence[str]]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    return buffer.getvalue()


def _cell(value: float) -> str:
    return "" if np.isnan(value) else repr(float(value))
