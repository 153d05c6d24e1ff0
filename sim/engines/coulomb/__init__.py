"""The exact engine: set-valued friction, event by event."""
