"""Members run: by a worker, on a cluster, and what that will take."""
