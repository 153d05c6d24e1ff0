"""The page: what stands on it, its layout, and what a report keeps beside it."""
