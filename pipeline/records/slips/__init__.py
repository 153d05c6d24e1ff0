"""Records of when blocks stick and slip: one file each."""
