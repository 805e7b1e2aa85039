"""What a reader gets: tables, maps, plots, report and viewer."""
