"""Estimates, tests and verdicts from arrays: no sentences, no figures, no data frames."""
