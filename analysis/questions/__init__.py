"""One file a question of the report."""
