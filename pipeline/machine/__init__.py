"""The machine: other processes, and signals."""
