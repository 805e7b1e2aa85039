"""How sure a run's numbers are: its inputs are varied, every output gets a band."""
