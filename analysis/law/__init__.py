"""The law of cascade sizes: the exponential, how well it fits, and its rivals."""
