"""The lattice of Sharma (2008), kept for comparison."""
