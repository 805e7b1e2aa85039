"""The body's parts put together for a case: geometry of each frame in, loads of each frame out."""
