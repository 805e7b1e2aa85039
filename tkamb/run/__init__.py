"""What surrounds the frames of a run: recording, resuming, rows, statuses, summary, profile."""
