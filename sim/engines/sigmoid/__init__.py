"""The stiff engine: smoothed friction by collocation and waveform iteration."""
