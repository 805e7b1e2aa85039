"""The report: one self-contained page."""

from pathlib import Path

from tkamb.output.atomic import write_text
from tkamb.results import Results


def write_report(results: Results, path: str | Path) -> None:
    """Write the report of a run as one self-contained HTML page."""
    rows = "".join(
        f"<tr><td>{time:.3f}</td><td>{force:.0f}</td><td>{status}</td></tr>"
        for time, force, status in zip(
            results["time_s"], results["force_total_N"], results.status, strict=True
        )
    )
    write_text(
        Path(path),
        "<!DOCTYPE html>\n<html lang='en'><head><meta charset='utf-8'><title>tkamb</title>"
        f"</head><body><table>{rows}</table></body></html>\n",
    )
