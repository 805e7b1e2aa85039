"""Studies on top of runs: trade-off, stability, uncertainty, cohort, wear, designs."""
