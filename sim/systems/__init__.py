"""Blocks, what couples, drives and brakes them."""
