"""Measured forces compared with those of a run, in words (`tkamb.run.recorded`)."""

from collections.abc import Mapping
from typing import Any

WHY_NOT = {
    "frames_failed": "failed",
    "frames_without_measurement": "without measurement",
    "frames_without_prediction": "without prediction",
}


def comparison_words(comparison: Mapping[str, Mapping[str, Any]]) -> tuple[str, str, bool]:
    """Return the largest RMSE, all errors and the frames left out; whether any were.

    Args:
        comparison: force -> what `compare_measured` returns, as in the summary.
    """
    (_, one), *others = comparison.items()
    counts = [_count_words(one)]
    counts += [f"{n}: {words}" for n, o in others if (words := _count_words(o)) != counts[0]]
    if low_high := one["measured_where_not_compared_N"]:
        counts[0] += f", where {low_high[0]:.0f} to {low_high[1]:.0f} N were measured"
    details = "; ".join([*(error_words(n, o) for n, o in comparison.items()), *counts])
    incomplete = any(o[key] for o in comparison.values() for key in WHY_NOT)
    if not one["frames_compared"]:
        return "no frame to compare", details, True
    return f"RMSE {one['rmse_BW']:.2f} BW", details, incomplete


def error_words(name: str, one: Mapping[str, Any]) -> str:
    """Return one force's errors in words."""
    if not one["frames_compared"]:
        return f"{name}: no frame"
    shares = "".join(
        f", {sign} {one[key]:.2f}"
        for sign, key in (("R²", "r_squared"), ("r", "pearson_r"))
        if one[key] is not None and one[key] == one[key]
    )
    return (
        f"{name} RMSE {one['rmse_N']:.0f} N ({one['rmse_BW']:.2f} BW), "
        f"bias {one['bias_N']:+.0f} N{shares}, peak {one['peak_predicted_N']:.0f} N at "
        f"{one['peak_predicted_time_s']:.2f} s for {one['peak_measured_N']:.0f} N at "
        f"{one['peak_measured_time_s']:.2f} s"
    )


def _count_words(one: Mapping[str, Any]) -> str:
    total = one["frames_compared"] + sum(one[key] for key in WHY_NOT)
    why = [f"{one[key]} {words}" for key, words in WHY_NOT.items() if one[key]]
    return ", ".join([f"{one['frames_compared']} of {total} frames compared", *why])
