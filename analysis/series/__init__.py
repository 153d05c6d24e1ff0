"""What is read off the series of one run: windows, cascades, cycles, when two runs part, and surrogates of blocks."""
