"""What a reader gets: report, comparison, check of a scene, viewer."""
