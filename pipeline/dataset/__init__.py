"""What is kept: the schema, writing, opening, state and soundness of a dataset."""
