"""A motion through a knee: frames, recording, resuming, statuses, columns, results."""
