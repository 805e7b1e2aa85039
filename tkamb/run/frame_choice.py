"""Choice of frames in text form, such as 0:100:5."""


def frames_slice(text: str) -> slice:
    """Return the slice of a text A:B or A:B:STEP.

    Raises:
        ValueError: the text has another form.
    """
    parts = text.split(":")
    if not 2 <= len(parts) <= 3:
        raise ValueError(f"'{text}' is not A:B or A:B:STEP")
    try:
        return slice(*(int(part) if part else None for part in parts))
    except ValueError:
        raise ValueError(f"'{text}' does not hold integers only") from None
