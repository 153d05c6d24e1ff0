"""What a run gives: its state, series of events and samples."""
