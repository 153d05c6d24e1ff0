"""Macro steps with waveform relaxation: what the engines that take them share."""
