"""Estimates of what blocks do together, over the systems of an ensemble, each with its interval."""
