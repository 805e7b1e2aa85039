"""The Pareto front of time and error, blind to differences within the timing's noise."""

from collections.abc import Sequence

NOISE = 1.2
"""Two medians of time within this factor count as equal."""


def on_front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Say which (seconds, error) are beaten by no other.

    One beats another if it is no less accurate and clearly faster, or more accurate and not
    clearly slower; clearly means by more than the noise.
    """
    return [not any(_beats(other, point) for other in points) for point in points]


def _beats(one: tuple[float, float], other: tuple[float, float]) -> bool:
    faster = one[0] * NOISE < other[0]
    not_slower = one[0] <= other[0] * NOISE
    return (one[1] <= other[1] and faster) or (one[1] < other[1] and not_slower)
