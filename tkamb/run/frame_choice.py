"""Which frames of a motion are computed, as text says it."""


def frames_slice(text: str) -> slice:
    """Return the slice that A:B or A:B:STEP says.

    Raises:
        ValueError: it says none.
    """
    parts = text.split(":")
    if not 2 <= len(parts) <= 3:
        raise ValueError(f"'{text}' is not A:B or A:B:STEP")
    try:
        return slice(*(int(part) if part else None for part in parts))
    except ValueError:
        raise ValueError(f"'{text}' holds something else than integers") from None
