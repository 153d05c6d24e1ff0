"""Series of single runs: windows, cascades, surrogates, and when two runs part."""
