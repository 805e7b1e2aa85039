"""Metadata of results.csv in a file of its own, as the W3C's "CSV on the Web" defines it.

A comment above the header would stop readers that expect the names in the first line, such as
`pandas.read_csv`, `numpy.genfromtxt(names=True)` and spreadsheets.

Source: W3C, Metadata Vocabulary for Tabular Data (2015), section 5.
"""

import json
from collections.abc import Mapping
from typing import Any

from tkamb import __version__
from tkamb.run.columns import COLUMNS, FAMILIES, KINDS, belongs

UNITS = {
    "N_per_mm": "N/mm",
    "N_per_deg": "N/deg",
    "mm_per_s": "mm/s",
    "seconds": "s",
    "percent": "%",
    "mm2": "mm²",
    "Nm": "N·m",
    **{unit: unit for unit in ("N", "mm", "MPa", "deg", "s", "BW")},
}
"""End of a column's name -> its unit. Longer ends come first."""
DATATYPES = {"text": "string", "integer": "integer"}


def unit_of(column: str) -> str:
    """Return the unit of a column; "1": a share, a number or a text."""
    if "_per_dome_mm_" in column:
        return "N/mm"
    return next((unit for end, unit in UNITS.items() if column.endswith(f"_{end}")), "1")


def table_metadata(columns: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """Return the content of results.csv-metadata.json: name, unit and meaning of each column.

    Args:
        columns: columns of results.csv.
        summary: content of summary.json.
    """
    meanings = {one.name: one.meaning for one in COLUMNS}
    rows = []
    for name in columns:
        family = next((one for one in FAMILIES if belongs(name, one)), name)
        rows.append(
            {
                "titles": name,
                "dc:description": meanings.get(name, meanings.get(family, "")),
                "schema:unitText": unit_of(name),
                "datatype": DATATYPES.get(KINDS.get(name, "number"), "number"),
            }
        )
    content = {
        "@context": ["http://www.w3.org/ns/csvw", {"@language": "en"}],
        "url": "results.csv",
        "dc:creator": f"tkamb {summary.get('versions', {}).get('tkamb', __version__)}",
        "dc:license": summary.get("licence") or "not stated",
        "dc:source": f"scene SHA-256 {summary.get('scene_sha256')}",
        "dialect": {"header": True, "delimiter": ",", "encoding": "utf-8"},
        "tableSchema": {"columns": rows},
    }
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"
