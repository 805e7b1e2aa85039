"""Studies that use runs: trade-off, stability, uncertainty, cohort, wear, designs."""
