"""Runs beside changed copies of themselves: how fast they part, whether their statistics agree, and their fates."""
