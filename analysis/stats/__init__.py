"""Arrays in, estimates out: no English, no figures, no frames."""
