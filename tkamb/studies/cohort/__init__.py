"""Runs of many subjects, trials, designs and contact models, with one table and one report."""
