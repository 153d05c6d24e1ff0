"""The charts, the paper and the field: scenes that are measured in one process, and what their pages say."""
