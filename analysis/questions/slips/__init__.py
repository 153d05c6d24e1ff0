"""Questions about cascades, episodes and single exits: one file each."""
