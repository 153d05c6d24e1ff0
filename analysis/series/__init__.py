"""Series of single runs: windows, cascades, cycles, surrogates, and when two runs part."""
