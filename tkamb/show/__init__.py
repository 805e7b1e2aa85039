"""Output for readers: report, comparison, check of a scene, viewer."""
