"""What pipeline and analysis both say: the design of an ensemble, the values of its keys, columns and names."""
