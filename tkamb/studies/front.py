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


def moved(first: Sequence[tuple[float, float]], second: Sequence[tuple[float, float]]) -> list[int]:
    """Return which points changed between on and off the front though no tie explains it.

    A tie explains it when the two points of every pair that decides lie within the noise of each
    other in one of the two measurements.

    Args:
        first: (seconds, error) of each point.
        second: the same points, measured again.
    """
    found = []
    marks = on_front(first), on_front(second)
    for i, (before, after) in enumerate(zip(*marks, strict=True)):
        points = first if after else second
        deciding = [j for j in range(len(points)) if _beats(points[j], points[i])]
        tied = all(_tied(first[i], first[j]) or _tied(second[i], second[j]) for j in deciding)
        if before != after and not tied:
            found.append(i)
    return found


def _tied(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return max(one[0], other[0]) <= NOISE * min(one[0], other[0])


def _beats(one: tuple[float, float], other: tuple[float, float]) -> bool:
    faster = one[0] * NOISE < other[0]
    not_slower = one[0] <= other[0] * NOISE
    return (one[1] <= other[1] and faster) or (one[1] < other[1] and not_slower)
