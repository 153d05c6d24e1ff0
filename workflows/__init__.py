"""The command line, the scenes that ship, and how the floors below are put together."""
