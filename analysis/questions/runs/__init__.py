"""Questions about whole runs, and about settings that differ: one file each."""
