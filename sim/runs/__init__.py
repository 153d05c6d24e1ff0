"""What a run gives: its state, series of events and samples, and pictures of them."""
