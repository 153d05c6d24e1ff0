"""Time stepping, to compare with."""
