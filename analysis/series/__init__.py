"""What is computed from the series of single runs: windows, cascades, cycles, when two runs part, surrogates."""
