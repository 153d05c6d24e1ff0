"""The scene file: its tables, the terms of its systems, and what of the user it names."""
