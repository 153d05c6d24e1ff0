"""Where a dataset lies, and its manifest: knows no scene."""
