"""Many runs as one: subjects by trials by designs by contact models, one table and one report."""
