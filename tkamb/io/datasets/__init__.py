"""Real data for the shipped scenes: fetched on demand, never by a run."""
