"""Two studies of the contact models: speed against accuracy, and stability at the extremes."""
