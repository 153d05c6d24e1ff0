"""Records of how blocks move: one file each."""
